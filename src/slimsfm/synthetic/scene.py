"""Camera paths around an object, and two takes: a tidy one to map, one with clutter for queries."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pycolmap
import trimesh
from jaxtyping import Float64

from slimsfm.arrays import Image
from slimsfm.geometry import Box
from slimsfm.synthetic import shapes, texture
from slimsfm.synthetic.objects import OBJECTS
from slimsfm.synthetic.render import Light, Scene, render

EVENING = Light(
    towards=(-0.8, 0.5, 0.7),
    lamp=(0.62, 0.56, 0.45),
    ambient=(0.44, 0.46, 0.50),
    backdrop=(52.0, 60.0, 74.0),
)
"""Lower, warmer and from another side than the light of mapping takes."""

NOISE_SIGMA = 1.5
"""Standard deviation of the sensor noise, in gray levels from 0 to 255."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Take:
    """A scene and a camera path through it. The object is the first mesh of the scene."""

    scene: Scene
    camera: pycolmap.Camera
    cam_from_object: tuple[pycolmap.Rigid3d, ...]
    seed: tuple[int, ...]

    def frame(self, index: int) -> Image:
        """Render one frame with sensor noise; equal calls give equal images."""
        return with_noise(render(self.scene, self.camera, self.cam_from_object[index]), (*self.seed, index))


def with_noise(image: Image, seed: tuple[int, ...]) -> Image:
    """Add sensor noise."""
    noise = np.random.default_rng(seed).standard_normal(image.shape, np.float32)
    return np.clip(np.rint(image + NOISE_SIGMA * noise), 0, 255).astype(np.uint8)


def object_box(mesh: trimesh.Trimesh) -> Box:
    """Axis-aligned box of a mesh."""
    low, high = np.asarray(mesh.bounds, dtype=np.float64)
    return Box((low + high) / 2, np.diag((high - low) / 2))


def mapping_take(name: str, frames: int, width: int, height: int, seed: int) -> Take:
    """An object alone on a pale table, filmed from all sides.

    Args:
        name: A key of `OBJECTS`.
        frames: Number of frames.
        width: Image width in pixels; the field of view stays the same.
        height: Image height in pixels.
        seed: Seed of the prints and the noise.

    Raises:
        ValueError: `name` is not in `OBJECTS`.
    """
    mesh, key = textured_object(name, seed), (seed, sorted(OBJECTS).index(name), 0)
    rng = np.random.default_rng(key)
    wood = texture.tinted_noise(rng, 512, 512, (186, 178, 168), 0.16)
    scene = Scene([mesh, shapes.ground(2.4, wood, shapes.lowest(mesh))], Light())
    path = mapping_path(frames, viewing_distance(mesh))
    return Take(scene=scene, camera=phone_camera(width, height, 0.0), cam_from_object=tuple(path), seed=key)


def query_take(name: str, frames: int, width: int, height: int, seed: int) -> Take:
    """The same object elsewhere: other light, a patterned table, clutter around it and posts in front of it.

    Args:
        name: A key of `OBJECTS`.
        frames: Number of frames.
        width: Image width in pixels; the field of view stays the same.
        height: Image height in pixels.
        seed: Seed of the prints, the clutter and the noise.

    Raises:
        ValueError: `name` is not in `OBJECTS`.
    """
    mesh, key = textured_object(name, seed), (seed, sorted(OBJECTS).index(name), 1)
    rng = np.random.default_rng(key)
    scene = elsewhere(rng, mesh)
    path = query_path(rng, frames, 1.3 * viewing_distance(mesh))
    return Take(scene=scene, camera=phone_camera(width, height, 0.02), cam_from_object=tuple(path), seed=key)


TAKES: dict[str, Callable[[str, int, int, int, int], Take]] = {"mapping": mapping_take, "query": query_take}


def textured_object(name: str, seed: int) -> trimesh.Trimesh:
    """The mesh of an object.

    Raises:
        ValueError: `name` is not in `OBJECTS`.
    """
    if name not in OBJECTS:
        raise ValueError(f"name must be one of {', '.join(OBJECTS)}, got {name!r}")
    return OBJECTS[name](seed)


def elsewhere(rng: np.random.Generator, mesh: trimesh.Trimesh) -> Scene:
    """An object in evening light on a patterned table, with clutter around it and posts in front of it."""
    return Scene(surrounded(rng, mesh), EVENING)


def surrounded(rng: np.random.Generator, mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """An object, a patterned table below it, posts in front of it and clutter around it."""
    cloth = texture.page(rng, 2000, 2000, cell=150) // 4 + 110
    table = shapes.ground(2.4, cloth, shapes.lowest(mesh))
    return [mesh, table, *posts(rng, mesh), *things(rng, mesh)]


def viewing_distance(mesh: trimesh.Trimesh) -> float:
    """Distance at which a mesh fills a good part of the image."""
    return 1.5 * object_box(mesh).diagonal


def phone_camera(width: int, height: int, change: float) -> pycolmap.Camera:
    """A camera with a horizontal field of view of 56 degrees and an off-center principal point.

    `change` varies focal length and principal point, so that two cameras differ.
    """
    focal = 600 / 640 * width * (1 + change)
    center = (width * (0.5 + 0.006 - change), height * (0.5 - 0.008 + change))
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[focal, focal, *center])


def posts(rng: np.random.Generator, mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Three thin posts around an object: each hides a part of it when the camera passes low behind it."""
    x, y, z = mesh.extents
    around, height = 0.5 * float(np.hypot(x, y)) + 0.04, 1.2 * z
    made = []
    for azimuth in np.radians([20.0, 140.0, 260.0]):
        radius = 0.062 * float(abs(x * np.sin(azimuth)) + abs(y * np.cos(azimuth)))
        label = texture.page(rng, 300, 120, cell=60)
        post = shapes.lathe([radius, radius], [height / 2, -height / 2], label, [label[:64, :64]] * 2)
        place = (around * np.cos(azimuth), around * np.sin(azimuth), shapes.lowest(mesh) + height / 2)
        made.append(post.apply_translation(place))
    return made


def things(rng: np.random.Generator, mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Seven printed boxes and cylinders in a ring, low enough not to hide the object."""
    around, made = 0.5 * float(np.linalg.norm(mesh.extents)) + 0.13, []
    for azimuth in 2 * np.pi * (np.arange(7) + rng.uniform(-0.2, 0.2, 7)) / 7:
        size = rng.uniform((0.06, 0.05, 0.04), (0.12, 0.10, 0.45 * mesh.extents[2]))
        images = [texture.page(rng, 220, 260, cell=80) for _ in range(6)]
        if rng.random() < 0.4:
            thing = shapes.lathe([size[1] / 2] * 2, [size[2] / 2, -size[2] / 2], images[0], images[:2])
        else:
            thing = shapes.box(size.tolist(), images)
        thing.apply_transform(trimesh.transformations.rotation_matrix(rng.uniform(0, np.pi), (0, 0, 1)))
        away = around + rng.uniform(0, 0.08)
        place = (away * np.cos(azimuth), away * np.sin(azimuth), shapes.lowest(mesh) + size[2] / 2)
        made.append(thing.apply_translation(place))
    return made


Vector = Float64[np.ndarray, "3"]


def look_at(eye: Vector, target: Vector, roll_deg: float = 0.0) -> pycolmap.Rigid3d:
    """Pose of a camera at `eye` that looks at `target`, upright except for a roll about its axis.

    Args:
        eye: Position of the camera in the world.
        target: Point to look at; not straight above or below the camera.
        roll_deg: Positive values turn the image counterclockwise.

    Raises:
        ValueError: The view is vertical, so upright is not defined.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-9:
        raise ValueError(f"eye {eye.tolist()} must not be straight above or below target {target.tolist()}")
    right /= np.linalg.norm(right)
    upright = np.stack([right, np.cross(forward, right), forward])
    cosine, sine = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    rolled = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) @ upright
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rolled), -rolled @ eye)


def mapping_path(frames: int, radius: float) -> list[pycolmap.Rigid3d]:
    """A spiral from 10 to 70 degrees above the horizon, with evenly spaced neighbors.

    Args:
        frames: Number of poses.
        radius: Distance to the center of the object, in meters; it varies by 8 %.
    """
    share = (np.arange(frames) + 0.5) / frames
    azimuths = 2 * np.pi * share * np.sqrt(frames / 8)
    places = eyes(azimuths, np.radians(10 + 60 * share), radius * (1 + 0.08 * np.sin(7 * share)))
    return [look_at(eye, np.zeros(3)) for eye in places]


def query_path(rng: np.random.Generator, frames: int, radius: float) -> list[pycolmap.Rigid3d]:
    """A different path: once around in the other direction, between 18 and 58 degrees above the horizon.

    The camera misses the center by up to 8 % of the radius, and rolls by up to 15 degrees.

    Args:
        rng: Random number generator for the camera shake.
        frames: Number of poses.
        radius: Mean distance to the center of the object, in meters; it varies by 22 %.
    """
    share = (np.arange(frames) + 0.5) / frames
    elevations = np.radians(38 + 20 * np.sin(2 * np.pi * (2.3 * share + 0.15)))
    radii = radius * (1 + 0.22 * np.sin(2 * np.pi * (1.7 * share + 0.4)))
    places = eyes(0.6 - 2 * np.pi * share, elevations, radii)
    targets = rng.uniform(-0.08, 0.08, (frames, 3)) * radius
    rolls = 15 * np.sin(2 * np.pi * 3 * share) * rng.uniform(0.5, 1, frames)
    return [
        look_at(eye, target, float(roll)) for eye, target, roll in zip(places, targets, rolls, strict=True)
    ]


def eyes(
    azimuths: Float64[np.ndarray, " n"],
    elevations: Float64[np.ndarray, " n"],
    radii: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Positions at these azimuths and elevations, in radians, and distances from the origin."""
    level = np.cos(elevations)
    unit = np.stack([level * np.cos(azimuths), level * np.sin(azimuths), np.sin(elevations)], axis=1)
    return radii[:, None] * unit
