"""Which images of a map a new image is likely to match."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap

from slimsfm.arrays import Ids, Mask
from slimsfm.geometry import project
from slimsfm.localization.point_descriptors import viewing_directions
from slimsfm.mapping.map import Map, observed
from slimsfm.mapping.pairs import Pairs

_BY_POINTS, _BY_VIEW = 10, 10  # neighbors of an image that see its inliers, and that should see the same
_FEWEST = 5, 15  # such points that both have
_MAX_ANGLE_DEG = 60.0  # between directions from which SIFT still matches a point


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalizedImage:
    """A new image and where it is."""

    cam_from_world: pycolmap.Rigid3d
    """Its pose."""

    camera: pycolmap.Camera
    """Its intrinsics."""

    points: Ids
    """Rows of the points of the map that support its pose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Neighbors:
    """Pairs of images that are worth matching."""

    pairs: Pairs
    """All of them."""

    unsure: frozenset[tuple[str, str]]
    """Those that should see the same points but are not known to: worth a cheap look first."""


def likely_neighbors(map: Map, new: Mapping[str, LocalizedImage]) -> Neighbors:
    """Pairs of a new image with others that it is likely to match.

    These are the ten images that observe most of the points that support its pose, and the ten that observe
    most of those that it should see: points that project into it from a direction within 60 degrees of that
    from which the map has seen them. Of the new images, these are the ten that should see most of the same.
    O(new images times observations).
    """
    names, directions = list(map.images), viewing_directions(map)
    incidence = observed(map).astype(np.int32)
    sees = {name: _should_see(map, directions, one) for name, one in sorted(new.items())}
    by_points: set[tuple[str, str]] = set()
    by_view: set[tuple[str, str]] = set()
    for name, one in new.items():
        supports = np.zeros(len(map.point3D_ids), np.int32)
        supports[one.points] = 1
        by_points |= _paired(name, _most(names, incidence @ supports, _BY_POINTS, _FEWEST[0]))
        seen = incidence @ sees[name].astype(np.int32)
        by_view |= _paired(name, _most(names, seen, _BY_VIEW, _FEWEST[1]))
        others = [other for other in sees if other != name]
        common = np.array([int((sees[other] & sees[name]).sum()) for other in others], np.int64)
        by_view |= _paired(name, _most(others, common, _BY_VIEW, _FEWEST[1]))
    return Neighbors(pairs=sorted(by_points | by_view), unsure=frozenset(by_view - by_points))


def _paired(name: str, others: list[str]) -> set[tuple[str, str]]:
    return {(min(name, other), max(name, other)) for other in others}


def _should_see(map: Map, directions: np.ndarray, one: LocalizedImage) -> Mask:
    """Points that an image should see, if nothing hides them."""
    pixels = project(map.points3D_in_world, one.cam_from_world, one.camera)
    inside = np.all((pixels >= 0) & (pixels < (one.camera.width, one.camera.height)), axis=1)
    towards = one.cam_from_world.inverse().translation - map.points3D_in_world
    lengths = np.linalg.norm(towards, axis=1) * np.linalg.norm(directions, axis=1)
    cosines = np.einsum("nd,nd->n", towards, directions) / np.maximum(lengths, 1e-12)
    return inside & (cosines >= np.cos(np.radians(_MAX_ANGLE_DEG)))


def _most(names: list[str], counts: np.ndarray, most: int, fewest: int) -> list[str]:
    order = np.argsort(-counts, kind="stable")[:most]
    return [names[place] for place in order if counts[place] >= fewest]
