"""The points of a map as the networks of OnePose take them: of the object alone, thinned out, described.

What is chosen and merged is as the authors' code does it [1], but for two things. They count tracks of all
points, for their images show hardly anything but the object; here those in the box are counted. And they
compare all points with all, where a tree finds the near ones.

References:
    [1] Sun, Wang, Zhang, He, Zhao, Zhang and Zhou, OnePose: One-Shot Object Pose Estimation without CAD
        Models, CVPR 2022; `filter_tkl.py`, `filter_points.py`, `feature_process.py` and `data_utils.py` of
        zju3dv/OnePose.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from slimsfm.arrays import Ids, Mask, Points3D
from slimsfm.geometry import Box
from slimsfm.mapping.map import Map, check_has_features


@dataclass(frozen=True, kw_only=True)
class OnePosePointsOptions:
    """Which points of a map the networks are given, and how much of each."""

    max_points: int = 2500
    """Tracks in the box are left out that are shorter than the shortest length than which at most so many are
    longer. With those of that very length more points may be left."""

    merge_m: float = 1e-3
    """Points nearer than this become one, in metres, for maps in metres."""

    merge_share: float = 0.004
    """The same for maps of unknown unit, as a share of the box's diagonal: a millimetre for a thing whose box
    has one of 25 cm."""

    leaves: int = 8
    """Observations of each point that are given by themselves."""

    seed: int = 0
    """Of the choice of these observations: equal maps and seeds give equal points."""

    def __post_init__(self) -> None:
        if self.max_points < 1:
            raise ValueError(f"max_points must be at least 1, got {self.max_points}")
        if not self.merge_m >= 0:
            raise ValueError(f"merge_m must not be negative, got {self.merge_m}")
        if not self.merge_share >= 0:
            raise ValueError(f"merge_share must not be negative, got {self.merge_share}")
        if self.leaves < 0:
            raise ValueError(f"leaves must not be negative, got {self.leaves}")


@dataclass(frozen=True, kw_only=True, eq=False)
class OnePosePoints:
    """Points of a map and what they look like."""

    points: Ids
    """Rows of the map's points. Of merged points the one nearest to their mean stands for all."""

    descriptors: Float32[np.ndarray, "m d"]
    """For each of them the mean of the descriptors of all observations, as stored; it is no unit vector."""

    leaves: Float32[np.ndarray, "m leaves d"]
    """For each of them descriptors of some observations; ones, all over, where there are too few."""


def prepare_points(map: Map, options: OnePosePointsOptions = OnePosePointsOptions()) -> OnePosePoints:
    """Choose, merge and describe the points of a map's object.

    1. Points in the box; all, where none is in it.
    2. Of them those of long tracks: at least as long as the shortest length such that at most `max_points`
       have longer ones. In a map of few images this is short, so that some points are always left.
    3. Point by point in order of id: it and all nearer than the merging distance become one, unless one of
       these has already done so; then the point is left out.
    4. The mean of all descriptors, and `leaves` of them, drawn at random.

    O(points log points + observations log observations), as long as few points are near each other.

    Raises:
        MapError: The map was made for direct matching alone.
    """
    check_has_features(map)
    chosen = _chosen(map, options.max_points)
    points3D = map.points3D_in_world[chosen]
    in_metres = map.info.unit == "metre"
    distance = options.merge_m if in_metres else options.merge_share * map.box.diagonal
    groups = _merged(points3D, distance)
    group_of_point = np.full(len(map.point3D_ids), -1, np.int64)
    group_of_point[chosen] = groups
    points = chosen[_representatives(points3D, groups)]
    sums, leaves, counts = _described(map, group_of_point, len(points), options)
    return OnePosePoints(points=points, descriptors=sums / counts[:, None], leaves=leaves)


def _chosen(map: Map, max_points: int) -> Ids:
    """Rows of the points in the box whose tracks are long enough."""
    seen = [seen.points for seen in map.observations.values()]
    lengths = np.bincount(np.concatenate(seen), minlength=len(map.point3D_ids))
    observed = lengths > 0
    wanted = observed & inside(map.box, map.points3D_in_world)
    rows = np.flatnonzero(wanted if wanted.any() else observed)
    if not len(rows):
        return rows
    longest_first = np.sort(lengths[rows])[::-1]
    return rows[lengths[rows] >= longest_first[min(max_points, len(rows) - 1)]]


def inside(box: Box, points3D: Points3D) -> Mask:
    """Which points are in a box, or on its sides."""
    along = (points3D - box.center) @ box.half_edges.T
    return np.all(np.abs(along) <= np.sum(box.half_edges**2, axis=1), axis=1)


def _merged(points3D: Points3D, distance: float) -> Ids:
    """For each point the group that it is merged into, -1 where it is left out; groups in order of point."""
    pairs = KDTree(points3D).query_pairs(distance, output_type="ndarray")
    gaps = np.linalg.norm(points3D[pairs[:, 0]] - points3D[pairs[:, 1]], axis=1)
    rows, columns = pairs[gaps < distance].T
    near = csr_array((np.ones(len(rows)), (rows, columns)), shape=(len(points3D), len(points3D)))
    near = csr_array(near + near.T)
    groups = np.full(len(points3D), -1, np.int64)
    count = 0
    for row in range(len(points3D)):
        members = np.append(near.indices[near.indptr[row] : near.indptr[row + 1]], row)
        if np.all(groups[members] < 0):
            groups[members] = count
            count += 1
    return groups


def _representatives(points3D: Points3D, groups: Ids) -> Int64[np.ndarray, " m"]:
    """For each group the row of the member nearest to the mean; of equally near ones the first."""
    rows = np.flatnonzero(groups >= 0)
    points3D, groups = points3D[rows], groups[rows]
    sums = np.zeros((int(groups.max(initial=-1)) + 1, 3))
    np.add.at(sums, groups, points3D)
    means = sums / np.bincount(groups, minlength=len(sums))[:, None]
    distances = np.linalg.norm(points3D - means[groups], axis=1)
    order = np.lexsort([distances, groups])
    _, first = np.unique(groups[order], return_index=True)
    return rows[order][first]


class _Described(NamedTuple):
    sums: Float32[np.ndarray, "m d"]
    leaves: Float32[np.ndarray, "m leaves d"]
    counts: Float32[np.ndarray, " m"]


def _described(map: Map, group_of_point: Ids, num_groups: int, options: OnePosePointsOptions) -> _Described:
    """The sum and number of each group's descriptors, and some of them."""
    group_of = {name: group_of_point[seen.points] for name, seen in map.observations.items()}
    slots = _slots(np.concatenate(list(group_of.values())), options.seed)
    dimensions = next(iter(map.features.values())).descriptors.shape[1]
    sums = np.zeros((num_groups, dimensions), np.float32)
    leaves = np.ones((num_groups, options.leaves, dimensions), np.float32)
    counts = np.zeros(num_groups, np.float32)
    start = 0
    for name, groups in group_of.items():
        taken, start = slots[start : start + len(groups)], start + len(groups)
        kept = np.flatnonzero(groups >= 0)
        taken, groups = taken[kept], groups[kept]
        descriptors = map.features[name].descriptors[map.observations[name].rows[kept]].astype(np.float32)
        np.add.at(sums, groups, descriptors)
        np.add.at(counts, groups, 1)
        given = taken < options.leaves
        leaves[groups[given], taken[given]] = descriptors[given]
    return _Described(sums, leaves, counts)


def _slots(groups: Ids, seed: int) -> Ids:
    """Number the observations of each group at random."""
    order = np.lexsort([np.random.default_rng(seed).random(len(groups)), groups])
    ordered = groups[order]
    starts = np.searchsorted(ordered, ordered)
    slots = np.empty(len(groups), np.int64)
    slots[order] = np.arange(len(groups)) - starts
    return slots
