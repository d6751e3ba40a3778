"""The rendered objects: metric and textured, each with its own difficulty for pose estimation."""

from collections.abc import Callable

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates

from slimsfm.synthetic import shapes, texture
from slimsfm.synthetic.texture import Picture

_TEXELS_PER_METER = 3500


def printed_box(seed: int) -> trimesh.Trimesh:
    """A package printed on every side: the easy case."""
    rng, size = np.random.default_rng([seed, 0]), (0.16, 0.07, 0.22)
    return shapes.box(size, [texture.page(rng, h, w) for h, w in _faces(size)])


def can(seed: int) -> trimesh.Trimesh:
    """A cylinder with a label around it: each view shows only a part of the label."""
    rng, radius, height = np.random.default_rng([seed, 1]), 0.05, 0.14
    label = texture.page(rng, _texels(height), _texels(2 * np.pi * radius), cell=110)
    lids = [texture.tinted_noise(rng, 256, 256, (170, 172, 178), 0.5, cells=12) for _ in range(2)]
    return shapes.lathe([radius, radius], [height / 2, -height / 2], label, lids)


def boulder(seed: int) -> trimesh.Trimesh:
    """A rough stone without planes or prints; its texture is 3D noise."""
    rng = np.random.default_rng([seed, 2])
    lattice = rng.random((32, 32, 32)).astype(np.float32)
    patches = []
    for side, fine in zip(shapes.sphere_sides(33), shapes.sphere_sides(320), strict=True):
        bumps = _solid_noise(lattice, side, frequency=1.3, octaves=3)
        points = 0.1 * side * (0.75 + 0.6 * bumps[..., None]) * (1.0, 0.85, 0.75)
        patches.append(shapes.Patch(points=points, image=_granite(lattice, fine)))
    return shapes.assemble(patches)


def tiled_box(seed: int) -> trimesh.Trimesh:
    """A cube with one repeated tile and a small label on each side: most matches are ambiguous."""
    rng, size = np.random.default_rng([seed, 3]), (0.15, 0.15, 0.15)
    side = _texels(size[0])
    tile = texture.page(rng, side // 5, side // 5, cell=40)
    tiles = np.tile(tile, (5, 5, 1))
    labels = [texture.label(rng, 90, 150) for _ in range(6)]
    return shapes.box(size, [texture.stamp(tiles, x, side // 5 + 8, 2 * side // 5 + 8) for x in labels])


def plain_box(seed: int) -> trimesh.Trimesh:
    """A box of one color with a label on each side: few features."""
    rng, size = np.random.default_rng([seed, 4]), (0.20, 0.14, 0.10)
    images = []
    for height, width in _faces(size):
        plain = texture.tinted_noise(rng, height, width, (196, 160, 116), 0.10)
        images.append(texture.stamp(plain, texture.page(rng, 90, 130, cell=45), width // 2, height // 2))
    return shapes.box(size, images)


def ball(seed: int) -> trimesh.Trimesh:
    """A printed sphere: only its print determines its rotation."""
    rng = np.random.default_rng([seed, 5])
    images = [texture.page(rng, 448, 448, cell=120) for _ in range(6)]
    sides = shapes.sphere_sides(25)
    return shapes.assemble(
        [shapes.Patch(points=0.085 * s, image=i) for s, i in zip(sides, images, strict=True)]
    )


OBJECTS: dict[str, Callable[[int], trimesh.Trimesh]] = {
    "ball": ball,
    "boulder": boulder,
    "can": can,
    "plain_box": plain_box,
    "printed_box": printed_box,
    "tiled_box": tiled_box,
}
"""From a seed of the print to a mesh in meters, z up, with the center of its box at the origin."""


def _texels(meters: float) -> int:
    return round(meters * _TEXELS_PER_METER)


def _faces(size: tuple[float, float, float]) -> list[tuple[int, int]]:
    x, y, z = (_texels(edge) for edge in size)
    return [(z, x), (z, y), (z, x), (z, y), (y, x), (y, x)]


def _solid_noise(lattice: np.ndarray, points: np.ndarray, frequency: float, octaves: int) -> np.ndarray:
    total = np.zeros(points.shape[:2], np.float32)
    for octave in range(octaves):
        places = np.moveaxis(points * frequency * 2**octave + 7.3 * octave, 2, 0)
        total += 0.55**octave * map_coordinates(lattice, places, order=1, mode="grid-wrap", output=np.float32)
    return total / sum(0.55**octave for octave in range(octaves))


def _granite(lattice: np.ndarray, points: np.ndarray) -> Picture:
    clouds = _solid_noise(lattice, points, frequency=3.0, octaves=5)
    grains = _solid_noise(lattice, points + 5, frequency=22.0, octaves=2)
    veins = np.exp(-(((_solid_noise(lattice, points + 11, frequency=4.0, octaves=4) - 0.5) / 0.02) ** 2))
    gray = 70 + 170 * (clouds - 0.25) + 150 * (grains > 0.62) - 90 * (grains < 0.36) - 70 * veins
    tint = np.array([1.0, 0.95, 0.88]) + 0.35 * (clouds[..., None] - 0.5) * np.array([1.0, 0.0, -1.0])
    return np.clip(gray[..., None] * tint, 0, 255).astype(np.uint8)
