"""Scenes whose look-alike parts plain Structure from Motion lays over each other, filmed once around.

The front of the box equals its back, the print of the can repeats, the mug carries one picture on either side,
and carpet and walls of the room repeat. All poses are known, so a folded model can be recognized.
"""

from collections.abc import Callable

import numpy as np
import trimesh

from deception import FLOOR_PERIOD, WALL_PERIOD, tiling
from slimsfm.synthetic import shapes, texture
from slimsfm.synthetic.render import Light, Scene
from slimsfm.synthetic.scene import Take, eyes, look_at, phone_camera

_TEXELS_PER_METER = 3000
_HALF_ROOM = 1.6  # meters from the middle of the room to its walls


def equal_sides(frames: int, width: int, height: int, seed: int) -> Take:
    """A box whose front equals its back and whose left equals its right side, on a table of wood."""
    rng, size = np.random.default_rng([seed, 10]), (0.18, 0.12, 0.15)
    x, y, z = (round(edge * _TEXELS_PER_METER) for edge in size)
    front, side, lid = (texture.page(rng, *shape, cell=150) for shape in ((z, x), (z, y), (y, x)))
    half = lid[: len(lid) // 2]
    lid = np.concatenate([half, half[::-1, ::-1]])
    mesh = shapes.box(size, [front, side, front, side, lid, lid])
    return _around(rng, [mesh, _table(rng, mesh)], frames, width, height, radius=0.42)


def repeating_can(frames: int, width: int, height: int, seed: int) -> Take:
    """A can whose print repeats once around, on a tiled floor, with a few things far behind it."""
    rng, radius, tall = np.random.default_rng([seed, 11]), 0.05, 0.15
    label = texture.page(
        rng, round(tall * _TEXELS_PER_METER), round(np.pi * radius * _TEXELS_PER_METER), cell=90
    )
    lid = texture.tinted_noise(rng, 128, 128, (170, 172, 178), 0.2, cells=8)
    lid = np.concatenate([lid[:64], lid[:64][::-1, ::-1]])
    mesh = shapes.lathe([radius] * 2, [tall / 2, -tall / 2], np.tile(label, (1, 2, 1)), [lid, lid])
    tile = texture.tinted_noise(rng, 300, 300, (178, 172, 160), 0.35, cells=10)
    floor = tiling(tile, FLOOR_PERIOD, 30, 30).apply_translation((0, 0, shapes.lowest(mesh)))
    return _around(rng, [mesh, floor, *_far_things(rng, 0.75, 6)], frames, width, height, radius=0.36)


def mug(frames: int, width: int, height: int, seed: int) -> Take:
    """A plain mug with one picture on either side and a handle, on a table of wood."""
    rng, radius, tall = np.random.default_rng([seed, 12]), 0.045, 0.11
    rows, columns = round(tall * _TEXELS_PER_METER), round(np.pi * radius * _TEXELS_PER_METER)
    half = texture.tinted_noise(rng, rows, columns, (214, 210, 200), 0.06)
    print_ = texture.page(rng, 3 * rows // 4, columns // 2, cell=60)
    half = texture.stamp(half, print_, columns // 4, rows // 8)
    plain = texture.tinted_noise(rng, 128, 128, (214, 210, 200), 0.06)
    body = shapes.lathe([radius] * 2, [tall / 2, -tall / 2], np.tile(half, (1, 2, 1)), [plain, plain])
    handle = shapes.box((0.03, 0.012, 0.07), [plain] * 6).apply_translation((radius + 0.015, 0, 0))
    return _around(rng, [body, handle, _table(rng, body)], frames, width, height, radius=0.28)


def repeating_room(frames: int, width: int, height: int, seed: int) -> Take:
    """A walk around a table in a room: the carpet and all walls repeat, pictures on the walls do not."""
    rng = np.random.default_rng([seed, 13])
    carpet = texture.page(rng, 300, 300, cell=60)
    floor = tiling(carpet, FLOOR_PERIOD * 2, 30, 30).apply_translation((0, 0, -0.45))
    wall_tile = texture.tinted_noise(rng, 250, 250, (200, 190, 175), 0.4, cells=12)
    walls, pictures = [], []
    for quarter in range(4):
        turn = trimesh.transformations.rotation_matrix(quarter * np.pi / 2, (0, 0, 1))
        upright = trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
        wall = tiling(wall_tile, WALL_PERIOD * 2, 18, 9).apply_transform(upright)
        walls.append(wall.apply_translation((0, _HALF_ROOM, 0.45)).apply_transform(turn))
        picture = shapes.box((0.35, 0.02, 0.28), [texture.page(rng, 280, 350, cell=70)] * 6)
        place = (rng.uniform(-0.7, 0.7), _HALF_ROOM - 0.02, rng.uniform(0.1, 0.5))
        pictures.append(picture.apply_translation(place).apply_transform(turn))
    table = shapes.box((0.5, 0.5, 0.06), [texture.tinted_noise(rng, 200, 200, (150, 120, 90), 0.2)] * 6)
    bowl = shapes.lathe(
        [0.08, 0.04], [0.05, -0.02], texture.page(rng, 120, 500, cell=50), [carpet[:64, :64]] * 2
    )
    meshes = [table, bowl.apply_translation((0.1, 0.05, 0.06)), floor, *walls, *pictures]
    return _around(rng, meshes, frames, width, height, radius=1.15)


def _around(
    rng: np.random.Generator,
    meshes: list[trimesh.Trimesh],
    frames: int,
    width: int,
    height: int,
    *,
    radius: float,
) -> Take:
    """Once around and a little further, at a height that goes up and down."""
    share = (np.arange(frames) + 0.5) / frames
    places = eyes(
        2.1 * np.pi * share,
        np.radians(24 + 7 * np.sin(2 * np.pi * 2 * share)),
        radius * (1 + 0.06 * np.sin(11 * share)),
    )
    targets = rng.uniform(-0.04, 0.04, (frames, 3)) * radius
    poses = tuple(look_at(eye, target) for eye, target in zip(places, targets, strict=True))
    camera = phone_camera(width, height, 0.0)
    key = tuple(int(number) for number in rng.integers(0, 2**31, 2))
    return Take(scene=Scene(meshes, Light()), camera=camera, cam_from_object=poses, seed=key)


def _table(rng: np.random.Generator, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    wood = texture.tinted_noise(rng, 512, 512, (186, 178, 168), 0.16)
    return shapes.ground(2.4, wood, shapes.lowest(mesh))


def _far_things(rng: np.random.Generator, around: float, count: int) -> list[trimesh.Trimesh]:
    things = []
    for azimuth in 2 * np.pi * (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / count:
        size = rng.uniform((0.06, 0.05, 0.10), (0.12, 0.10, 0.25))
        thing = shapes.box(size.tolist(), [texture.page(rng, 220, 260, cell=80) for _ in range(6)])
        place = (around * np.cos(azimuth), around * np.sin(azimuth), size[2] / 2 - 0.075)
        things.append(thing.apply_translation(place))
    return things


LOOKALIKES: dict[str, Callable[[int, int, int, int], Take]] = {
    "equal_sides": equal_sides,
    "mug": mug,
    "repeating_can": repeating_can,
    "repeating_room": repeating_room,
}
"""From the number of frames, the image width and height in pixels, and the seed to the take."""
