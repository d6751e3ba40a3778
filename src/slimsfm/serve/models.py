"""Models that the page draws: GLB, OBJ or PLY as one triangle mesh with one texture, placed in a map."""

import base64
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pycolmap
import trimesh
from jaxtyping import Float64, Int64
from PIL import Image as PillowImage
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from slimsfm.arrays import Points3D
from slimsfm.errors import InputError
from slimsfm.files import contents_of, plain
from slimsfm.geometry import Box

SUFFIXES = (".glb", ".obj", ".ply")
"""Formats of models."""

_MAX_BYTES = 100_000_000
_MAX_TRIANGLES = 200_000  # more take a phone seconds to read
_MAX_TEXTURE = 2048  # longer side in pixels
_DIGITS = 6
_IDENTITY = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A triangle mesh in the frame of a map."""

    positions: Points3D
    """One per vertex, in the frame and unit of the map."""

    normals: Float64[np.ndarray, "n 3"]
    """Outward directions, of length 1."""

    uvs: Float64[np.ndarray, "n 2"]
    """Places in the texture, from (0, 0) at its bottom left to (1, 1)."""

    colors: Float64[np.ndarray, "n 3"]
    """Colors from 0 to 1, which the texture is multiplied by."""

    triangles: Int64[np.ndarray, "m 3"]
    """Rows of the vertices of each triangle."""

    texture: PillowImage.Image | None
    """RGB; None: the colors alone."""

    def to_json(self) -> dict[str, Any]:
        """The answer to `GET /v1/maps/{id}/model`: flat lists, and the texture as a data URI."""
        flat = {name: getattr(self, name) for name in ("positions", "normals", "uvs", "colors")}
        return {
            **{name: [float(f"{x:.{_DIGITS}g}") for x in rows.ravel()] for name, rows in flat.items()},
            "indices": self.triangles.ravel().tolist(),
            "texture": None if self.texture is None else _data_uri(self.texture),
        }


@dataclass(frozen=True, kw_only=True)
class _Anchor:
    scale: float = 1.0
    quaternion_xyzw: tuple[float, ...] = _IDENTITY
    translation: tuple[float, ...] = (0.0, 0.0, 0.0)


def read_anchor(path: Path) -> pycolmap.Sim3d:
    """Read where a model stands in a map: `world_from_model`.

    Args:
        path: JSON with `scale`, `quaternion_xyzw` and `translation`; what is missing changes nothing.

    Raises:
        InputError: The file is missing or holds something else.
    """
    with contents_of(path, "not an anchor", 'give {"scale": 1, "translation": [x, y, z]} in map units'):
        found = plain(json.loads(path.read_text(encoding="utf-8")), _Anchor)
        quaternion, translation = np.array(found.quaternion_xyzw), np.array(found.translation)
        if quaternion.shape != (4,) or translation.shape != (3,):
            raise ValueError("quaternion_xyzw must be 4 numbers and translation 3")
        if not (found.scale > 0 and np.linalg.norm(quaternion) > 0):
            raise ValueError("scale must be positive and quaternion_xyzw not zero")
        rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
        return pycolmap.Sim3d(found.scale, rotation, translation)


def read_model(path: Path, box: Box, world_from_model: pycolmap.Sim3d | None = None) -> Model:
    """Read a model.

    Args:
        path: GLB, OBJ or PLY; textures of an OBJ lie beside it.
        box: Box of the map.
        world_from_model: Where the model stands; None: in the center of the box, as large as it.

    Raises:
        InputError: The file is missing, of another format, damaged, too large, or has no triangles.
    """
    _check_file(path)
    with contents_of(path, "not a readable model"):
        parts = [one for one in trimesh.load_scene(path).dump() if isinstance(one, trimesh.Trimesh)]
        count = sum(len(part.faces) for part in parts)
        if not count:
            raise InputError("has no triangles")
        if count > _MAX_TRIANGLES:
            raise InputError(f"has {count} triangles, more than {_MAX_TRIANGLES}; simplify it")
        return _model(parts, box, world_from_model)


def _check_file(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a model must be one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: no such model")
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path}: has more than {_MAX_BYTES / 1e6:g} MB; simplify it or shrink its textures")


def _model(parts: list[trimesh.Trimesh], box: Box, world_from_model: pycolmap.Sim3d | None) -> Model:
    colors = np.concatenate([_colors(part) for part in parts])
    textured = any(_image(part) is not None for part in parts)
    joined: Any = trimesh.util.concatenate([(_with_texture if textured else _bare)(part) for part in parts])
    normals = np.concatenate([np.asarray(part.vertex_normals) for part in parts])
    vertices = np.asarray(joined.vertices, dtype=np.float64)
    if not np.all(np.isfinite(vertices)) or not np.any(np.ptp(vertices, axis=0)):
        raise InputError("has vertices that are no numbers, or all in one place")
    anchor = world_from_model or _in_box(vertices, box)
    uvs = np.asarray(joined.visual.uv) if textured else np.zeros((len(vertices), 2))
    return Model(
        positions=anchor * vertices,
        normals=normals @ anchor.rotation.matrix().T,
        uvs=uvs.astype(np.float64),
        colors=colors,
        triangles=np.asarray(joined.faces, dtype=np.int64),
        texture=_shrunk(joined.visual.material.image) if textured else None,
    )


def _in_box(vertices: Points3D, box: Box) -> pycolmap.Sim3d:
    """Center on center, diagonal on diagonal."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = box.diagonal / float(np.linalg.norm(high - low))
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(), box.center - scale * (low + high) / 2)


def _image(part: trimesh.Trimesh) -> PillowImage.Image | None:
    """The texture of a part; None where it has none, or its vertices no places in it."""
    visual = part.visual
    if not isinstance(visual, TextureVisuals) or visual.uv is None:
        return None
    material = visual.material
    if isinstance(material, PBRMaterial):
        return material.baseColorTexture
    return getattr(material, "image", None)


def _colors(part: trimesh.Trimesh) -> Float64[np.ndarray, "n 3"]:
    """Color of each vertex; white where a texture says all."""
    visual: Any = part.visual
    if _image(part) is None:
        if isinstance(visual, TextureVisuals):
            found = np.broadcast_to(np.asarray(visual.material.main_color), (len(part.vertices), 4))
        else:
            found = np.asarray(visual.vertex_colors)
        return found[:, :3] / 255.0
    factor = getattr(visual.material, "baseColorFactor", None)
    color = np.ones(3) if factor is None else np.asarray(factor)[:3] / 255.0
    return np.tile(color, (len(part.vertices), 1))


def _with_texture(part: trimesh.Trimesh) -> trimesh.Trimesh:
    """A part whose material is an image alone, white if it had none: these can be joined into one."""
    image, old = _image(part), cast("Any", part.visual)
    if image is None:
        image, uv = PillowImage.new("RGB", (4, 4), (255, 255, 255)), np.full((len(part.vertices), 2), 0.5)
    else:
        uv = np.asarray(old.uv)
    visual = TextureVisuals(uv=uv, material=SimpleMaterial(image=_shrunk(image)))
    return trimesh.Trimesh(part.vertices, part.faces, visual=visual, process=False)


def _bare(part: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


def _shrunk(image: PillowImage.Image) -> PillowImage.Image:
    factor = min(1.0, _MAX_TEXTURE / max(image.size))
    size = (max(1, round(image.width * factor)), max(1, round(image.height * factor)))
    return image.convert("RGB").resize(size) if size != image.size else image.convert("RGB")


def _data_uri(image: PillowImage.Image) -> str:
    data = io.BytesIO()
    image.save(data, "PNG")
    return "data:image/png;base64," + base64.b64encode(data.getvalue()).decode("ascii")
