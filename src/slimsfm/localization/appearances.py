"""Group the observations of each point by how they look, so that the mean of a group resembles them.

Descriptors of one point may differ much between images, for some extractors and some points more than for
others. Their mean then resembles none of them. Such a point gets several appearances, each the mean of some
of its observations.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from slimsfm.arrays import Descriptors, Ids, Mask
from slimsfm.features import unit_rows
from slimsfm.mapping.map import Map

MOST_APPEARANCES = 4
"""Largest number of appearances of a point."""

_NEAR = 0.6  # of the largest angle between matching descriptors: an observation resembles its mean
_STRAY = 0.1  # largest share of a point's observations that resemble no mean


@dataclass(frozen=True, kw_only=True, eq=False)
class Appearances:
    """The appearances of all points of a map."""

    points: Ids
    """Row of the point of each appearance, ascending; each point has at least one."""

    sums: Float32[np.ndarray, "appearances d"]
    """Sum of the unit descriptors of the observations of each appearance."""

    of_observations: dict[str, Int64[np.ndarray, " _"]]
    """By name of image, the appearance that each of its observations belongs to."""


def find_appearances(map: Map) -> Appearances:
    """Group the observations of each point of a map.

    A point has one appearance if nearly all of its observations resemble their mean, as measured by the
    extractor's `descriptor_metric`. Otherwise the observation farthest from those that groups started with
    starts another group, until nearly all resemble the mean of their group, or there are four.
    O(observations).
    """
    sums, seen = descriptor_sums(map), [one.points for one in map.observations.values()]
    owners = np.concatenate([np.zeros(0, np.int64), *seen])
    groups = np.zeros(len(owners), np.int64)
    limit = np.float32(np.cos(_NEAR * map.descriptor_metric.max_distance))
    split = _are_scattered(map, unit_rows(sums), limit)
    chosen = np.flatnonzero(split[owners])
    chosen = chosen[np.argsort(owners[chosen], kind="stable")]
    descriptors = _descriptors_of(map, chosen)
    groups[chosen] = _grouped(descriptors, owners[chosen], limit)
    counts = np.ones(len(sums), np.int64)
    np.maximum.at(counts, owners, groups + 1)
    rows = (np.cumsum(counts) - counts)[owners] + groups
    points = np.repeat(np.arange(len(sums)), counts)
    parts = np.where(split[points, None], 0, sums[points])
    np.add.at(parts, rows[chosen], descriptors)
    each = np.split(rows, np.cumsum([len(one) for one in seen])[:-1])
    return Appearances(points=points, sums=parts, of_observations=dict(zip(map.images, each, strict=True)))


def descriptor_sums(map: Map) -> Float32[np.ndarray, "points d"]:
    """The sum of the unit descriptors of each point's observations."""
    sums: np.ndarray | None = None
    for name, seen in map.observations.items():
        descriptors = _observed(map, name)
        if sums is None:
            sums = np.zeros((len(map.point3D_ids), descriptors.shape[1]), np.float32)
        np.add.at(sums, seen.points, descriptors)  # an image may see a point twice
    return np.zeros((0, 0), np.float32) if sums is None else sums


def _observed(map: Map, name: str) -> Descriptors:
    return unit_rows(map.features[name].descriptors[map.observations[name].rows])


def _are_scattered(map: Map, means: Descriptors, limit: np.float32) -> Mask:
    """Which points have many observations that do not resemble their mean."""
    stray, counts = np.zeros((2, len(means)), np.int64)
    for name, seen in map.observations.items():
        cosines = np.einsum("nd,nd->n", _observed(map, name), means[seen.points])
        np.add.at(stray, seen.points, cosines < limit)
        np.add.at(counts, seen.points, 1)
    return stray > _STRAY * counts


def _descriptors_of(map: Map, chosen: Ids) -> Descriptors:
    """Descriptors of some observations, counted through all images."""
    found, start = np.zeros((len(chosen), 0), np.float32), 0
    for name, seen in map.observations.items():
        here = np.flatnonzero((chosen >= start) & (chosen < start + len(seen.points)))
        descriptors = _observed(map, name)
        if not found.shape[1]:
            found = np.zeros((len(chosen), descriptors.shape[1]), np.float32)
        found[here] = descriptors[chosen[here] - start]
        start += len(seen.points)
    return found


def _grouped(descriptors: Descriptors, owners: Ids, limit: np.float32) -> Int64[np.ndarray, " n"]:
    """The group of each observation of points that need several, in order of point."""
    groups = np.zeros(len(owners), np.int64)
    if not len(owners):
        return groups
    starts = np.flatnonzero(np.diff(owners, prepend=-1))
    place = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(owners)))
    first = _first_largest(_to_means(descriptors, place), place, starts)
    nearest = np.einsum("nd,nd->n", descriptors, descriptors[first[place]])
    scattered = np.ones(len(starts), bool)
    for group in range(1, MOST_APPEARANCES):
        farthest = _first_largest(-nearest, place, starts)
        cosines = np.einsum("nd,nd->n", descriptors, descriptors[farthest[place]])
        moved = scattered[place] & (cosines > nearest)
        groups[moved], nearest[moved] = group, cosines[moved]
        stray = _to_means(descriptors, place * MOST_APPEARANCES + groups) < limit
        scattered = np.add.reduceat(stray, starts, dtype=np.int64) > _STRAY * np.diff(
            starts, append=len(owners)
        )
    return groups


def _first_largest(
    values: Float32[np.ndarray, " n"], place: Int64[np.ndarray, " n"], starts: Int64[np.ndarray, " points"]
) -> Int64[np.ndarray, " points"]:
    """For each point the observation with the largest value."""
    return np.lexsort([-values, place])[starts]


def _to_means(descriptors: Descriptors, groups: Ids) -> Float32[np.ndarray, " n"]:
    """Cosine between each descriptor and the mean of its group."""
    _, which = np.unique(groups, return_inverse=True)
    sums = np.zeros((int(which.max()) + 1, descriptors.shape[1]), np.float32)
    np.add.at(sums, which, descriptors)
    return np.einsum("nd,nd->n", descriptors, unit_rows(sums)[which])
