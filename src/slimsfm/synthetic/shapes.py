"""Textured meshes made of patches: grids of points, each with its own image."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float64
from PIL import Image as PilImage
from trimesh.visual import TextureVisuals

from slimsfm.arrays import Points3D
from slimsfm.synthetic.texture import Picture

Grid = Float64[np.ndarray, "rows columns 3"]

_GUTTER = 8
"""Texels around each image that repeat its rim, so that blurred lookups do not see its neighbor."""

_SIDES = (
    ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
)
"""Normal, right and up direction of each side of a cube, seen from outside."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Patch:
    """A curved sheet with an image."""

    points: Grid
    """In meters; rows run down and columns run right, seen from outside."""

    image: Picture

    places: Float64[np.ndarray, "rows columns 2"] | None = None
    """Position of each point in the image, from (0, 0) at the top left to (1, 1); None spaces them evenly."""


def assemble(patches: Sequence[Patch]) -> trimesh.Trimesh:
    """Join patches into one mesh whose texture stacks their images vertically.

    Returns:
        A mesh with the center of its axis-aligned box at the origin.
    """
    padded = [np.pad(p.image, ((_GUTTER, _GUTTER), (_GUTTER, _GUTTER), (0, 0)), mode="edge") for p in patches]
    width = max(image.shape[1] for image in padded)
    atlas = np.concatenate(
        [np.pad(i, ((0, 0), (0, width - i.shape[1]), (0, 0)), mode="edge") for i in padded]
    )
    tops = np.cumsum([0, *(image.shape[0] for image in padded)])
    starts = np.cumsum([0, *(p.points.shape[0] * p.points.shape[1] for p in patches)])
    texels = np.concatenate([_texels(p) + np.array([0, top]) for p, top in zip(patches, tops, strict=False)])
    vertices = np.concatenate([p.points.reshape(-1, 3) for p in patches])
    faces = np.concatenate([_triangles(p) + start for p, start in zip(patches, starts, strict=False)])
    uv = np.stack([texels[:, 0] / width, 1 - texels[:, 1] / len(atlas)], axis=1)
    visual = TextureVisuals(uv=uv, image=PilImage.fromarray(atlas))
    center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return trimesh.Trimesh(vertices - center, faces, visual=visual, process=False)


def box(size: Sequence[float], images: Sequence[Picture]) -> trimesh.Trimesh:
    """A box with one image per side: four around counterclockwise from -y, then top and bottom."""
    points = [_side(side, 2) * np.array(size) / 2 for side in range(6)]
    return assemble([Patch(points=p, image=image) for p, image in zip(points, images, strict=True)])


def lathe(
    radii: Sequence[float], heights: Sequence[float], image: Picture, lids: Sequence[Picture]
) -> trimesh.Trimesh:
    """A body of revolution about z: its outline from top to bottom, the print around it, and two lids."""
    turns = np.linspace(0, 2 * np.pi, 97)
    ring = np.stack([np.cos(turns), np.sin(turns), np.zeros_like(turns)], axis=1)
    outline = np.array([radii, heights]).T
    lengths = np.cumsum([0, *np.linalg.norm(np.diff(outline, axis=0), axis=1)])
    down, right = np.meshgrid(lengths / lengths[-1], turns / (2 * np.pi), indexing="ij")
    wall = np.array([r * ring + (0, 0, z) for r, z in outline])
    lid = np.array([r * ring for r in (0.0, 1.0)])
    top = Patch(
        points=lid * radii[0] + (0, 0, heights[0]), image=lids[0], places=lid[..., :2] * (0.5, -0.5) + 0.5
    )
    bottom = Patch(points=top.points[:, ::-1] * (radii[-1] / radii[0]), image=lids[1], places=top.places)
    bottom.points[..., 2] = heights[-1]
    return assemble([Patch(points=wall, image=image, places=np.stack([right, down], axis=2)), top, bottom])


def sphere_sides(count: int) -> list[Grid]:
    """Points of a unit sphere as the six sides of an inflated cube, `count` x `count` each.

    Six sides give texels of nearly equal size; one image wrapped around two poles does not.
    """
    return [
        side / np.linalg.norm(side, axis=2, keepdims=True)
        for side in (_side(k, count, swell=True) for k in range(6))
    ]


def ground(size: float, image: Picture, z: float) -> trimesh.Trimesh:
    """A horizontal square, centered on the z axis."""
    mesh = assemble([Patch(points=_side(4, 9) * (size / 2, size / 2, 0), image=image)])
    return mesh.apply_translation((0, 0, z))


def _side(side: int, count: int, *, swell: bool = False) -> Grid:
    out, right, up = (np.array(axis) for axis in _SIDES[side])
    steps = np.linspace(-1, 1, count)
    steps = np.tan(steps * np.pi / 4) if swell else steps
    return out + steps[None, :, None] * right - steps[:, None, None] * up


def _texels(patch: Patch) -> Float64[np.ndarray, "n 2"]:
    rows, columns = patch.points.shape[:2]
    height, width = patch.image.shape[:2]
    x, y = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    places = np.stack([x, y], axis=2) if patch.places is None else patch.places
    return places.reshape(-1, 2) * (width, height) + _GUTTER


def _triangles(patch: Patch) -> np.ndarray:
    rows, columns = patch.points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return np.concatenate([np.stack([a, b, d], axis=1), np.stack([b, c, d], axis=1)])


def lowest(mesh: trimesh.Trimesh) -> float:
    """Smallest z of a mesh."""
    vertices: Points3D = np.asarray(mesh.vertices)
    return float(vertices[:, 2].min())
