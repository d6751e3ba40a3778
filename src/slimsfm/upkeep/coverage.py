"""How much of the surface of an object or a room a map has seen, and from how many directions."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from slimsfm.geometry import Box
from slimsfm.mapping.map import Map

_CELLS = 32  # of the surface, along the diagonal of the box
_DIRECTIONS = 60  # evenly on the sphere, about 30 degrees apart


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """What a map has seen, in cells of a 32nd of the diagonal of the box."""

    points: int
    """Number of points."""

    surface: int
    """Number of cells that hold a point."""

    views: int
    """Number of pairs of such a cell and one of 60 directions from which it was seen."""


def coverage(map: Map, box: Box | None = None) -> Coverage:
    """Measure what a map has seen.

    Args:
        map: The map.
        box: Box whose diagonal gives the size of the cells; by default the map's own. The same box makes two
            maps comparable.
    """
    side = (box or map.box).diagonal / _CELLS
    places = np.floor(map.points3D_in_world / side).astype(np.int64)
    cells, cell_of = np.unique(places, axis=0, return_inverse=True)
    directions, seen = _sphere(), set[int]()
    for name, image in map.images.items():
        points = map.observations[name].points
        towards = image.projection_center() - map.points3D_in_world[points]
        nearest = np.argmax(towards @ directions.T, axis=1)
        seen.update((cell_of.ravel()[points] * _DIRECTIONS + nearest).tolist())
    return Coverage(points=len(map.point3D_ids), surface=len(cells), views=len(seen))


def _sphere() -> Float64[np.ndarray, "n 3"]:
    """Directions evenly on the sphere: Fibonacci's spiral."""
    steps = np.arange(_DIRECTIONS) + 0.5
    heights, angles = 1 - 2 * steps / _DIRECTIONS, steps * np.pi * (3 - np.sqrt(5))
    radii = np.sqrt(1 - heights**2)
    return np.column_stack([radii * np.cos(angles), radii * np.sin(angles), heights])
