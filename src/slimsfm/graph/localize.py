"""The paper's Algorithm 1: localize every reference image from every other one.

References:
    Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set, 2025.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float32, Int64

from slimsfm.arrays import Descriptors, Points2D
from slimsfm.features import match_nearest, unit_rows
from slimsfm.graph.candidates import all_pairs, likely_pairs
from slimsfm.graph.source import GraphOptions, PairErrors, PairIndices, References
from slimsfm.mapping.map import Map

_CACHED_IMAGES = 64  # with 4096 descriptors of 128 numbers 2 MB each


@dataclass(frozen=True, kw_only=True, eq=False)
class _Image:
    """A reference image in both its roles."""

    keypoints: Points2D
    descriptors: Descriptors
    seeing: Float32[np.ndarray, "k d"]  # descriptors of those keypoints that see a point
    points: Int64[np.ndarray, " k"]  # rows of these points


class LocalizeEdges:
    """Localizes images from each other by matching them anew.

    For v from u the keypoints of v are matched against the points that u sees, each described as u sees it.
    Complexity: two matchings a pair, of all keypoints of the one with the points of the other.
    """

    def __init__(self, map: Map, options: GraphOptions) -> None:
        self._references = References(map, options.ransac)
        self._options = options
        self._image = lru_cache(_CACHED_IMAGES)(self._read)

    def pairs(self) -> PairIndices:
        """Likely pairs, or all."""
        choose = all_pairs if self._options.candidates == "all" else likely_pairs
        return choose(self._references.map)

    def errors(self, u: int, v: int) -> PairErrors:
        """Localize u and v from each other."""
        return PairErrors(v_from_u=self.error(u, v), u_from_v=self.error(v, u))

    def error(self, reference: int, query: int) -> float:
        """Relative corner error of the query's pose, estimated from the reference alone."""
        one, other = self._image(reference), self._image(query)
        pairs = match_nearest(other.descriptors, one.seeing, self._options.matching)
        return self._references.error(query, other.keypoints[pairs[:, 0]], one.points[pairs[:, 1]])

    def _read(self, index: int) -> _Image:
        map_, name = self._references.map, self._references.names[index]
        features, seen = map_.features[name], map_.observations[name]
        descriptors = unit_rows(features.descriptors)
        return _Image(
            keypoints=features.keypoints.astype(np.float64),
            descriptors=descriptors,
            seeing=descriptors[seen.rows],
            points=seen.points,
        )
