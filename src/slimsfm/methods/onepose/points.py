"""Input points for the networks of OnePose and OnePose++: points of the object, thinned out and described.

Points are chosen and merged as in the authors' code [1], with two exceptions. The authors count the tracks of
all points, because their images show little else than the object; here only points in the box count. And a
tree finds near points, instead of a comparison of all pairs.

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
    """Which points of a map the networks get, and how they are described."""

    max_points: int = 2500
    """Shorter tracks are dropped until at most this many points have tracks longer than the shortest kept
    length. All points of that length are kept, so the result may be larger."""

    merge_m: float = 1e-3
    """Points closer than this are merged, in meters; for maps in meters."""

    merge_share: float = 0.004
    """The same for maps of unknown unit, relative to the diagonal of the box: one millimeter for a diagonal
    of 25 cm."""

    leaves: int = 8
    """Number of single observations of each point."""

    seed: int = 0
    """Seed of the choice of these observations: equal maps and seeds give equal points."""

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
    """Points of a map and their descriptors."""

    points: Ids
    """Rows of the map's points; merged points are represented by the one closest to their mean."""

    descriptors: Float32[np.ndarray, "m d"]
    """Mean of the stored descriptors of all observations, not scaled to unit length."""

    leaves: Float32[np.ndarray, "m leaves d"]
    """Descriptors of some observations of each point; filled up with ones if there are too few."""


def prepare_points(map: Map, options: OnePosePointsOptions = OnePosePointsOptions()) -> OnePosePoints:
    """Choose, merge and describe the points of a map's object.

    1. Take the points in the box, or all points if the box is empty.
    2. Keep those with long tracks: at least as long as the shortest length such that at most `max_points`
       tracks are longer. In a map of few images this length is small, so some points always remain.
    3. Point by point in order of id, merge the point and all points within the merging distance, unless one
       of them is already merged; then drop the point.
    4. Compute the mean of all descriptors, and draw `leaves` of them at random.

    O(points log points + observations log observations) if few points are close to each other.

    Raises:
        MapError: The map is for direct matching only.
    """
    check_has_features(map)
    chosen = _chosen(map, options.max_points)
    points3D = map.points3D_in_world[chosen]
    in_meters = map.info.unit == "metre"
    distance = options.merge_m if in_meters else options.merge_share * map.box.diagonal
    groups = _merged(points3D, distance)
    group_of_point = np.full(len(map.point3D_ids), -1, np.int64)
    group_of_point[chosen] = groups
    points = chosen[_representatives(points3D, groups)]
    sums, leaves, counts = _described(map, group_of_point, len(points), options)
    return OnePosePoints(points=points, descriptors=sums / counts[:, None], leaves=leaves)


def _chosen(map: Map, max_points: int) -> Ids:
    """Rows of the points in the box with sufficiently long tracks."""
    seen = [seen.points for seen in map.observations.values()]
    lengths = np.bincount(np.concatenate(seen), minlength=len(map.point3D_ids))
    observed = lengths > 0
    wanted = observed & in_box(map.box, map.points3D_in_world)
    rows = np.flatnonzero(wanted if wanted.any() else observed)
    if not len(rows):
        return rows
    longest_first = np.sort(lengths[rows])[::-1]
    return rows[lengths[rows] >= longest_first[min(max_points, len(rows) - 1)]]


def in_box(box: Box, points3D: Points3D) -> Mask:
    """Mask of the points in a box, including its surface."""
    along = (points3D - box.center) @ box.half_edges.T
    return np.all(np.abs(along) <= np.sum(box.half_edges**2, axis=1), axis=1)


def _merged(points3D: Points3D, distance: float) -> Ids:
    """Group of each point after merging, -1 for dropped points; groups are in order of points."""
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
    """Row of the member of each group that is closest to the mean; ties go to the first."""
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
    """Sum, some examples and number of the descriptors of each group."""
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
