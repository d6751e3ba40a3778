"""Match the query against points of the map, each described by the mean of its observations [1].

References:
    [1] Sattler, Leibe and Kobbelt, Fast Image-based Localization using Direct 2D-to-3D Matching, ICCV 2011.
"""

import numpy as np
from jaxtyping import Float32

from slimsfm.arrays import Descriptors
from slimsfm.features import NearestOptions, match_nearest, unit_rows
from slimsfm.localization.strategy import PointMatches
from slimsfm.mapping.map import Map, PointDescriptors


class Direct:
    """Matches against all described points at once. O(keypoints x points) a query."""

    def __init__(self, map: Map, matching: NearestOptions = NearestOptions()) -> None:
        self._matching = matching
        self._described = map.point_descriptors or describe_points(map)

    def match(self, descriptors: Descriptors) -> PointMatches:
        """Match the query's descriptors against the points' mean descriptors."""
        pairs = match_nearest(descriptors, self._described.descriptors, self._matching)
        return PointMatches(keypoints=pairs[:, 0], points=self._described.points[pairs[:, 1]])


def describe_points(map: Map) -> PointDescriptors:
    """All points, each with the mean, made of unit length, of the descriptors of its observations."""
    points = np.arange(len(map.point3D_ids), dtype=np.int64)
    return PointDescriptors(points=points, descriptors=unit_rows(descriptor_sums(map)))


def descriptor_sums(map: Map) -> Float32[np.ndarray, "points d"]:
    """The sum of the unit descriptors of each point's observations."""
    sums: np.ndarray | None = None
    for name, seen in map.observations.items():
        descriptors = unit_rows(map.features[name].descriptors[seen.rows])
        if sums is None:
            sums = np.zeros((len(map.point3D_ids), descriptors.shape[1]), np.float32)
        np.add.at(sums, seen.points, descriptors)  # an image may see a point twice
    return np.zeros((0, 0), np.float32) if sums is None else sums
