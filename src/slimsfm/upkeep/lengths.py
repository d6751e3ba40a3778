"""Distances in a map, and how exactly the map knows them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from slimsfm.errors import InputError
from slimsfm.mapping.map import Map

_ERROR_PX = 0.5  # of a keypoint
_MAX_ERROR = 0.1  # largest 95 % bound of a distance, over the distance


@dataclass(frozen=True, kw_only=True)
class Length:
    """A distance in map units."""

    length: float
    """The distance."""

    relative_bound: float
    """Relative error of it that 95 % stay below, from the size of a pixel at the distance of the points."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Place:
    position: Float64[np.ndarray, "3"]
    sigma: float


def distance_between(map: Map, a: str, b: str) -> Length:
    """Measure the distance between two cameras or points.

    Args:
        map: The map.
        a: Name of an image, or id of a point of the COLMAP model.
        b: The same of the other end.

    Raises:
        InputError: The map has no such image or point, both are the same, or they are too close to each other
            to tell the distance.
    """
    if a == b:
        raise InputError(f"between must be two different images or points, got {a!r} twice")
    ends = [_place(map, name) for name in (a, b)]
    length = float(np.linalg.norm(ends[0].position - ends[1].position))
    bound = 2 * float(np.hypot(ends[0].sigma, ends[1].sigma))
    if bound > _MAX_ERROR * length:
        raise InputError(
            f"{a} and {b} are too close to each other to determine the scale: {length:.3g} map units, known "
            f"to ±{bound:.2g}; choose two that are further apart"
        )
    return Length(length=length, relative_bound=bound / length)


def _place(map: Map, name: str) -> _Place:
    if name in map.images:
        image = map.images[name]
        return _Place(position=image.projection_center(), sigma=_pixel(map, name))
    if name.isdecimal() and map.model.exists_point3D(int(name)):
        point = map.model.point3D(int(name))
        seen_by = [map.model.image(one.image_id) for one in point.track.elements]
        images = seen_by or list(map.images.values())
        nearest = min(images, key=lambda one: np.linalg.norm(one.projection_center() - point.xyz))
        depth = float((nearest.cam_from_world() * point.xyz)[2])
        return _Place(position=point.xyz, sigma=_ERROR_PX * abs(depth) / _focal(map, nearest.name))
    raise InputError(
        f"{name!r} is neither an image of the map, such as {next(iter(map.images))!r}, nor the id of one of "
        f"its {len(map.point3D_ids)} points"
    )


def _pixel(map: Map, name: str) -> float:
    """Uncertainty of a camera's position: half a pixel at the median distance of the points before it."""
    seen = map.observations[name].points
    points = map.points3D_in_world[seen] if len(seen) else map.points3D_in_world
    depths = (map.images[name].cam_from_world() * points)[:, 2]
    ahead = depths[depths > 0]
    return _ERROR_PX * float(np.median(ahead)) / _focal(map, name) if len(ahead) else np.inf


def _focal(map: Map, name: str) -> float:
    return map.camera(name).mean_focal_length()
