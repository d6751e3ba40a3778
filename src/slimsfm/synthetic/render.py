"""A ray caster for textured meshes: exact to a small fraction of a pixel, on the CPU, without OpenGL.

Embree finds the triangle that each pixel sees. The rest follows in double precision: on a triangle with
corners a, b, c in the camera frame, the ray along d meets the point with barycentric weights proportional to
(b x c)·d, (c x a)·d, (a x b)·d. So each attribute of a triangle is a ratio of two linear forms of d. Its
derivative between pixels selects the level of detail of the texture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
import trimesh
from jaxtyping import Float32, Float64, Int64
from trimesh.ray.ray_pyembree import RayMeshIntersector
from trimesh.visual import TextureVisuals

from slimsfm.arrays import Ids, Image, Points2D
from slimsfm.synthetic.texture import Picture

Rgb = tuple[float, float, float]
_SUBPIXELS = np.array([(-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)])
_LEVELS = 13
_BATCH = 16_000  # rays shaded at once; their arrays fit into the CPU cache


@dataclass(frozen=True, kw_only=True)
class Light:
    """A distant lamp and ambient light; a matte surface reflects its texture times their sum."""

    towards: Rgb = (0.4, -0.5, 1.0)
    """Direction to the lamp, of any length."""

    lamp: Rgb = (0.5, 0.5, 0.5)
    ambient: Rgb = (0.55, 0.55, 0.55)
    backdrop: Rgb = (150.0, 155.0, 160.0)
    """Color of the background, RGB from 0 to 255."""


class Scene:
    """Meshes under a light, prepared for ray casting."""

    def __init__(self, meshes: Sequence[trimesh.Trimesh], light: Light) -> None:
        """Prepare the meshes.

        Args:
            meshes: Textured meshes in the world frame, in meters.
            light: The light.
        """
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        self.light = light
        self.vertices = np.concatenate([mesh.vertices for mesh in meshes])
        self.faces = np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=False)])
        self.mesh_of_face = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
        normals = np.concatenate([mesh.vertex_normals for mesh in meshes])
        towards = np.array(light.towards) / np.linalg.norm(light.towards)
        lit = np.clip(normals @ towards, 0, None)
        uv = np.concatenate([_visual(mesh).uv for mesh in meshes])
        self.attributes = np.stack([uv[:, 0], 1 - uv[:, 1], lit, np.ones_like(lit)], axis=1)[self.faces]
        self.texture = _Pyramids([_picture(mesh) for mesh in meshes])
        solid = trimesh.Trimesh(self.vertices, self.faces, process=False)
        self.face_normals = np.asarray(solid.face_normals)
        self.intersector = RayMeshIntersector(solid)

    def forms(self, cam_from_world: pycolmap.Rigid3d) -> Float64[np.ndarray, "4 3 faces"]:
        """Per face, the linear forms of u, v, brightness and 1, up to a common factor."""
        a, b, c = np.moveaxis((cam_from_world * self.vertices)[self.faces], 1, 0)
        weights = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
        return np.ascontiguousarray(np.einsum("fka,kfd->adf", self.attributes, weights))


def _visual(mesh: trimesh.Trimesh) -> TextureVisuals:
    if not isinstance(mesh.visual, TextureVisuals) or mesh.visual.uv is None:
        raise ValueError(f"meshes must have a texture and its coordinates, got {mesh.visual}")
    return mesh.visual


def _picture(mesh: trimesh.Trimesh) -> Picture:
    image = _visual(mesh).material.image
    if image is None:
        raise ValueError("meshes must have a texture image, got None")
    return np.asarray(image.convert("RGB"))


class _Pyramids:
    """Textures at half-octave steps of size, in one list of texels: one lookup serves every pixel."""

    def __init__(self, images: Sequence[Picture]) -> None:
        levels = [_shrunk(image, 2 ** (k / 2)) for image in images for k in range(_LEVELS)]
        self.texels = np.concatenate([level.reshape(-1, 3) for level in levels])
        self.sizes = np.array([level.shape[1::-1] for level in levels]).T
        self.starts = np.cumsum([0, *(level.shape[0] * level.shape[1] for level in levels)])[:-1]

    def look_up(
        self, images: Ids, uv: Float64[np.ndarray, "2 n"], spread: Float64[np.ndarray, " n"]
    ) -> Float32[np.ndarray, "n 3"]:
        """Bilinear values at (u, v), in the level with texels about `spread` times as wide."""
        steps = np.rint(2 * np.log2(np.maximum(spread, 1))).astype(np.int64)
        level = images * _LEVELS + np.minimum(steps, _LEVELS - 1)
        sizes = self.sizes[:, level]
        place = np.clip(uv * sizes - 0.5, 0, sizes - 1)
        low = np.minimum(place.astype(np.int64), sizes - 2)
        right, down = (place - low).astype(np.float32)
        index = self.starts[level] + low[1] * sizes[0] + low[0]
        result = np.zeros((len(index), 3), np.float32)
        for step, weight in (
            (0, (1 - right) * (1 - down)),
            (1, right * (1 - down)),
            (sizes[0], (1 - right) * down),
            (sizes[0] + 1, right * down),
        ):
            result += self.texels[index + step] * weight[:, None]
        return result


def _shrunk(image: Picture, factor: float) -> Picture:
    size = tuple(max(2, round(edge / factor)) for edge in image.shape[1::-1])
    return image if factor == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def render(scene: Scene, camera: pycolmap.Camera, cam_from_world: pycolmap.Rigid3d) -> Image:
    """Render a scene.

    Casts one ray through the center of each pixel, with textures blurred to the footprint of the pixel.
    Pixels at the rim of a surface are the mean of four rays.

    Args:
        scene: The scene, in the world frame.
        camera: A camera of any COLMAP model; the image has its width and height.
        cam_from_world: Pose of the camera.
    """
    pixels, forms = pixel_centers(camera), scene.forms(cam_from_world)
    directions = _directions(camera, pixels)
    faces = _seen(scene, cam_from_world, directions)
    colors = _shade(scene, forms, directions, faces, camera.mean_focal_length())
    rims = np.flatnonzero(_rims(scene, faces.reshape(camera.height, camera.width)))
    finer = _directions(camera, (pixels[rims, None] + _SUBPIXELS).reshape(-1, 2))
    finer_colors = _shade(
        scene, forms, finer, _seen(scene, cam_from_world, finer), camera.mean_focal_length()
    )
    colors[rims] = finer_colors.reshape(-1, 4, 3).mean(axis=1)
    return np.clip(np.rint(colors), 0, 255).astype(np.uint8).reshape(camera.height, camera.width, 3)


def visible_meshes(
    scene: Scene, camera: pycolmap.Camera, cam_from_world: pycolmap.Rigid3d
) -> Int64[np.ndarray, "height width"]:
    """Index of the mesh that the center of each pixel sees, or -1."""
    faces = _seen(scene, cam_from_world, _directions(camera, pixel_centers(camera)))
    return np.where(faces < 0, -1, scene.mesh_of_face[faces]).reshape(camera.height, camera.width)


def pixel_centers(camera: pycolmap.Camera) -> Points2D:
    """Centers of all pixels, row by row; the first is (0.5, 0.5)."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _directions(camera: pycolmap.Camera, pixels: Points2D) -> Float64[np.ndarray, "3 n"]:
    return np.stack([*np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2).T, np.ones(len(pixels))])


def _seen(scene: Scene, cam_from_world: pycolmap.Rigid3d, directions: Float64[np.ndarray, "3 n"]) -> Ids:
    world_from_cam = cam_from_world.inverse()
    towards = (world_from_cam.rotation.matrix() @ directions).T
    origins = np.broadcast_to(world_from_cam.translation, towards.shape)
    return scene.intersector.intersects_first(origins, towards).astype(np.int64)


def _shade(
    scene: Scene,
    forms: Float64[np.ndarray, "4 3 faces"],
    directions: Float64[np.ndarray, "3 n"],
    faces: Ids,
    focal_length: float,
) -> Float32[np.ndarray, "n 3"]:
    colors = np.empty((len(faces), 3), np.float32)
    colors[:] = scene.light.backdrop
    hits = np.flatnonzero(faces >= 0)
    for hit in np.array_split(hits, 1 + len(hits) // _BATCH):
        colors[hit] = _colors(scene, forms, directions[:, hit], faces[hit], focal_length)
    return colors


def _colors(
    scene: Scene,
    forms: Float64[np.ndarray, "4 3 faces"],
    directions: Float64[np.ndarray, "3 n"],
    faces: Ids,
    focal_length: float,
) -> Float32[np.ndarray, "n 3"]:
    mesh, form = scene.mesh_of_face[faces], forms.take(faces, axis=2)
    values = form[:, 0] * directions[0] + form[:, 1] * directions[1] + form[:, 2]
    uv, lit = values[:2] / values[3], values[2] / values[3]
    sizes = scene.texture.sizes[:, mesh * _LEVELS]
    change = (form[:2, :2] - uv[:, None] * form[3, :2]) * (sizes / (values[3] * focal_length))[:, None]
    texels = scene.texture.look_up(mesh, uv, _spread(change))
    brightness = np.clip(lit, 0, 1).astype(np.float32)[:, None]
    return texels * (
        brightness * np.array(scene.light.lamp, np.float32) + np.array(scene.light.ambient, np.float32)
    )


def _spread(change: Float64[np.ndarray, "2 2 n"]) -> Float64[np.ndarray, " n"]:
    """Width of a pixel's footprint in texels: the mean, but at least half the length if it is slanted."""
    (u_x, u_y), (v_x, v_y) = change
    length = np.sqrt(u_x * u_x + u_y * u_y + v_x * v_x + v_y * v_y)
    return np.maximum(np.sqrt(np.abs(u_x * v_y - u_y * v_x)), 0.5 * length)


def _rims(scene: Scene, faces: Int64[np.ndarray, "height width"]) -> np.ndarray:
    rims = np.zeros(faces.shape, bool)
    for one, other in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        y, x = np.nonzero(faces[one] != faces[other])
        a, b = faces[one][y, x], faces[other][y, x]
        bent = np.sum(scene.face_normals[a] * scene.face_normals[b], axis=1) < 0.9
        rim = (a < 0) | (b < 0) | (scene.mesh_of_face[a] != scene.mesh_of_face[b]) | bent
        rims[one][y[rim], x[rim]] = True
        rims[other][y[rim], x[rim]] = True
    return rims
