"""Deceptive scenes, in which the background or the object itself supports wrong poses.

In the room the floor and the walls repeat, so a camera shifted by a period sees the same. A twin of the
object creates a second place from which the object looks right. A box with repeated or mirrored sides looks
right from behind. Each scene has a mapping take and a query take, as the plain objects have. The true pose is
that of the mapped object at the origin.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pycolmap
import trimesh
from jaxtyping import Float64

from slimsfm.synthetic import shapes, texture
from slimsfm.synthetic.objects import printed_box
from slimsfm.synthetic.render import Light, Scene
from slimsfm.synthetic.scene import (
    EVENING,
    Take,
    Vector,
    elsewhere,
    eyes,
    look_at,
    mapping_path,
    phone_camera,
    posts,
    query_path,
    things,
    viewing_distance,
)
from slimsfm.synthetic.texture import Picture

FLOOR_PERIOD, WALL_PERIOD = 0.12, 0.10
"""Edge lengths of the tiles of the floor and the wallpaper, in meters."""

TWIN_FROM_OBJECT = pycolmap.Rigid3d(
    pycolmap.Rotation3d(np.array([0.0, 0.0, np.radians(115.0)])), np.array([0.21, -0.09, 0.0])
)
"""Pose of the twin: the motion from the object to it."""

_TEXELS_PER_METER = 2500
_WALLS = 0.8  # meters from the object to the walls
_ROOM = (-115.0, 25.0)  # azimuths in degrees from which a camera sees the object in front of a wall
_MAPPING, _QUERY = 0, 1

TakeFunction = Callable[[int, int, int, int], Take]


@dataclass(frozen=True, kw_only=True)
class Deception:
    """An object and its two takes."""

    object: Callable[[int], trimesh.Trimesh]
    """From a seed to the mesh, with the center of its box at the origin."""

    mapping: TakeFunction
    """From the number of frames, the image width and height in pixels, and the seed to the take."""

    query: TakeFunction
    """Same arguments as `mapping`."""


def label_box(seed: int) -> trimesh.Trimesh:
    """A carton with a different print on each side and plain margins."""
    rng, size = _rng(seed, "patterned_room", 2), (0.16, 0.11, 0.20)
    images = []
    for height, width in _faces(size):
        plain = texture.tinted_noise(rng, height, width, (204, 190, 168), 0.12)
        print_ = texture.page(rng, height * 4 // 5, width * 4 // 5, cell=90)
        images.append(texture.stamp(plain, print_, width // 10, height // 10))
    return shapes.box(size, images)


def patterned_room(frames: int, width: int, height: int, seed: int) -> Take:
    """The carton in the corner of a room with strictly periodic floor and wallpaper, filmed from nearby."""
    rng, mesh = _rng(seed, "patterned_room", _MAPPING), label_box(seed)
    scene = Scene([mesh, *room(mesh, seed)], Light())
    share = (np.arange(frames) + 0.5) / frames
    sweep = 0.5 + 0.5 * np.sin(2 * np.pi * 2.5 * share)
    views = _views(sweep, 15 + 40 * share, 0.62 + 0.1 * np.sin(17 * share))
    aims = rng.uniform(-0.1, 0.1, (frames, 2))
    poses = [_aim(eye, aim, 0.0) for eye, aim in zip(views, aims, strict=True)]
    return _take(scene, phone_camera(width, height, 0.0), poses, _key(seed, "patterned_room", _MAPPING))


def patterned_room_query(frames: int, width: int, height: int, seed: int) -> Take:
    """The same room with other light and clutter; the carton is sometimes small, hidden or at the rim."""
    rng, mesh = _rng(seed, "patterned_room", _QUERY), label_box(seed)
    light = Light(towards=(0.7, -0.3, 0.5), lamp=(0.60, 0.55, 0.46), ambient=(0.42, 0.44, 0.48))
    meshes = [mesh, *room(mesh, seed), *posts(rng, mesh), *things(rng, mesh), *_boards(rng, mesh)]
    share = (np.arange(frames) + 0.5) / frames
    sweep = 0.5 + 0.5 * np.cos(2 * np.pi * 3.5 * share)
    radii = 0.95 - 0.45 * np.cos(2 * np.pi * 2.2 * share)
    views = _views(sweep, 26 + 14 * np.sin(2 * np.pi * 4.7 * share), radii)
    aims = np.array([0.40, 0.26]) * rng.uniform(-1, 1, (frames, 2))
    rolls = rng.uniform(-12, 12, frames).tolist()
    poses = [_aim(*view) for view in zip(views, aims, rolls, strict=True)]
    return _take(
        Scene(meshes, light), phone_camera(width, height, 0.02), poses, _key(seed, "patterned_room", _QUERY)
    )


def room(mesh: trimesh.Trimesh, seed: int) -> list[trimesh.Trimesh]:
    """A floor below a mesh and two walls behind it, each with one repeated tile drawn from the seed."""
    rng, floor = _rng(seed, "patterned_room", 3), shapes.lowest(mesh)
    tiles = [_tile(rng, period) for period in (FLOOR_PERIOD, WALL_PERIOD)]
    ground = tiling(tiles[0], FLOOR_PERIOD, 30, 30).apply_translation((0.0, 0.0, floor))
    wall = tiling(tiles[1], WALL_PERIOD, 36, 18).apply_transform(_turn((1, 0, 0)))
    other = wall.copy().apply_transform(_turn((0, 0, 1)))
    middle = floor + 9 * WALL_PERIOD
    return [
        ground,
        wall.apply_translation((0.0, _WALLS, middle)),
        other.apply_translation((-_WALLS, 0.0, middle)),
    ]


def tiling(tile: Picture, period: float, columns: int, rows: int) -> trimesh.Trimesh:
    """A horizontal sheet of equal square tiles around the z axis, seen from above.

    `period` is the edge length of a tile, in meters.

    All tiles have the same texture coordinates, so the pattern repeats exactly at every distance.
    """
    height, width = tile.shape[:2]
    rim = min(height, width) // 4
    image = np.pad(tile, ((rim, rim), (rim, rim), (0, 0)), mode="wrap")
    x, y = (np.repeat(np.arange(count + 1.0), 2)[1:-1] * period for count in (columns, rows))
    points = np.stack(np.broadcast_arrays(x[None], -y[:, None], 0.0), axis=2)
    right, down = (
        (np.arange(2 * count) % 2 * size + rim) / (size + 2 * rim)
        for count, size in ((columns, width), (rows, height))
    )
    places = np.stack(np.broadcast_arrays(right[None], down[:, None]), axis=2)
    mesh = shapes.assemble([shapes.Patch(points=points, image=image, places=places)])
    mesh.update_faces(mesh.nondegenerate_faces())
    return mesh


def twins(frames: int, width: int, height: int, seed: int) -> Take:
    """A printed box alone on a marbled table."""
    mesh = printed_box(seed)
    scene = Scene([mesh, _marble(mesh, seed)], Light())
    poses = mapping_path(frames, 1.1 * viewing_distance(mesh))
    return _take(scene, phone_camera(width, height, 0.0), poses, _key(seed, "twins", _MAPPING))


def twins_query(frames: int, width: int, height: int, seed: int) -> Take:
    """The same box on the same table next to its rotated twin; the camera turns to both in turn."""
    rng, mesh = _rng(seed, "twins", _QUERY), printed_box(seed)
    twin = mesh.copy().apply_transform(np.vstack([TWIN_FROM_OBJECT.matrix(), (0, 0, 0, 1)]))
    scene = Scene([mesh, _marble(mesh, seed), twin, *things(rng, mesh)], EVENING)
    around = query_path(rng, frames, 1.5 * viewing_distance(mesh))
    share = 0.5 + 0.5 * np.sin(2 * np.pi * 3.1 * (np.arange(frames) + 0.5) / frames)
    shifts = [pycolmap.Rigid3d(pycolmap.Rotation3d(), -s * TWIN_FROM_OBJECT.translation) for s in share]
    poses = [pose * shift for pose, shift in zip(around, shifts, strict=True)]
    return _take(scene, phone_camera(width, height, 0.02), poses, _key(seed, "twins", _QUERY))


def ambiguous_box(seed: int) -> trimesh.Trimesh:
    """A box that looks almost the same from behind.

    Front and back have one print, except for a small label on the front. Right is the mirror image of left.
    Top and bottom are equal after half a turn.
    """
    rng, size = _rng(seed, "mirrored_box", 2), (0.18, 0.12, 0.15)
    (front, side, _, _, top, _) = (texture.page(rng, *face, cell=150) for face in _faces(size))
    half = top[: len(top) // 2]
    top = np.concatenate([half, half[::-1, ::-1]])
    label = texture.label(rng, 64, 100)
    labelled = texture.stamp(front, label, front.shape[1] // 2, front.shape[0] // 2)
    return shapes.box(size, [labelled, side[:, ::-1], front, side, top, top])


def mirrored_box(frames: int, width: int, height: int, seed: int) -> Take:
    """The ambiguous box alone on a pale table, filmed from all sides."""
    rng, mesh = _rng(seed, "mirrored_box", _MAPPING), ambiguous_box(seed)
    wood = texture.tinted_noise(rng, 512, 512, (186, 178, 168), 0.16)
    scene = Scene([mesh, shapes.ground(2.4, wood, shapes.lowest(mesh))], Light())
    poses = mapping_path(frames, viewing_distance(mesh))
    return _take(scene, phone_camera(width, height, 0.0), poses, _key(seed, "mirrored_box", _MAPPING))


def mirrored_box_query(frames: int, width: int, height: int, seed: int) -> Take:
    """The ambiguous box on another table, in other light, with clutter around it and posts in front of it."""
    rng, mesh = _rng(seed, "mirrored_box", _QUERY), ambiguous_box(seed)
    scene = elsewhere(rng, mesh)
    poses = query_path(rng, frames, 1.4 * viewing_distance(mesh))
    return _take(scene, phone_camera(width, height, 0.02), poses, _key(seed, "mirrored_box", _QUERY))


DECEPTIONS: dict[str, Deception] = {
    "mirrored_box": Deception(object=ambiguous_box, mapping=mirrored_box, query=mirrored_box_query),
    "patterned_room": Deception(object=label_box, mapping=patterned_room, query=patterned_room_query),
    "twins": Deception(object=printed_box, mapping=twins, query=twins_query),
}
"""Of each name the object and its takes."""

_NAMES = ("patterned_room", "twins", "mirrored_box")


def _key(seed: int, name: str, part: int) -> tuple[int, ...]:
    return (seed, 6, _NAMES.index(name), part)


def _rng(seed: int, name: str, part: int) -> np.random.Generator:
    return np.random.default_rng(_key(seed, name, part))


def _take(scene: Scene, camera: pycolmap.Camera, poses: list[pycolmap.Rigid3d], key: tuple[int, ...]) -> Take:
    return Take(scene=scene, camera=camera, cam_from_object=tuple(poses), seed=key)


def _tile(rng: np.random.Generator, period: float) -> Picture:
    edge = round(period * _TEXELS_PER_METER)
    return texture.page(rng, edge, edge, cell=edge // 2) // 2 + 70


def _marble(mesh: trimesh.Trimesh, seed: int) -> trimesh.Trimesh:
    """A table with soft clouds and a few veins, the same for both takes."""
    rng = _rng(seed, "twins", 3)
    clouds = texture.tinted_noise(rng, 1024, 1024, (176, 170, 164), 0.5, cells=40)
    return shapes.ground(2.4, clouds, shapes.lowest(mesh))


def _boards(rng: np.random.Generator, mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Two boards in front of an object: from behind a board only a part of the object is visible."""
    height, made = 0.95 * mesh.extents[2], []
    for azimuth in (-85.0, -20.0):
        images = [texture.page(rng, 300, 200, cell=90) for _ in range(6)]
        board = shapes.box((0.012, 0.13, height), images)
        board.apply_translation((0.24, 0.0, shapes.lowest(mesh) + height / 2))
        made.append(
            board.apply_transform(trimesh.transformations.rotation_matrix(np.radians(azimuth), (0, 0, 1)))
        )
    return made


def _faces(size: tuple[float, float, float]) -> list[tuple[int, int]]:
    x, y, z = (round(3500 * edge) for edge in size)
    return [(z, x), (z, y), (z, x), (z, y), (y, x), (y, x)]


def _turn(axis: tuple[int, int, int]) -> np.ndarray:
    return np.asarray(trimesh.transformations.rotation_matrix(np.pi / 2, axis))


def _views(
    sweep: Float64[np.ndarray, " n"],
    elevations_deg: Float64[np.ndarray, " n"],
    radii: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Eyes around the origin; a sweep from 0 to 1 covers all azimuths with a wall behind the object."""
    azimuths = _ROOM[0] + (_ROOM[1] - _ROOM[0]) * sweep
    return eyes(np.radians(azimuths), np.radians(elevations_deg), radii)


def _aim(eye: Vector, aim: Float64[np.ndarray, "2"], roll_deg: float) -> pycolmap.Rigid3d:
    """Look past the origin, which appears off-center by `aim`, in focal lengths to the right and down."""
    towards = np.array([-aim[0], -aim[1], 1.0]) * np.linalg.norm(eye)
    target = look_at(eye, np.zeros(3)).inverse() * towards
    return look_at(eye, target, roll_deg)
