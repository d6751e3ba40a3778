"""The paper's Algorithm 1: localize every reference image from every other one.

References:
    Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set, 2025.
"""

from functools import lru_cache

import numpy as np

from slimsfm.features import unit_rows
from slimsfm.graph.candidates import all_pairs, likely_pairs
from slimsfm.graph.source import GraphOptions, PairErrors, PairIndices, References
from slimsfm.localization.matching import matching_with
from slimsfm.localization.strategy import MatchingOptions, Query
from slimsfm.mapping.map import Map

_CACHED_IMAGES = 64  # with 4096 descriptors of 128 numbers 2 MB each


class LocalizeEdges:
    """Localizes images from each other by matching them anew.

    For v from u the keypoints of v are matched against the points that u sees, each described as u sees it.
    Complexity: two matchings a pair, of all keypoints of the one with the points of the other.
    """

    def __init__(self, map: Map, options: GraphOptions) -> None:
        self._references = References(map, options.ransac)
        self._options = options
        self._matching = matching_with(map, MatchingOptions(matcher=options.matcher), _CACHED_IMAGES)
        self._query = lru_cache(_CACHED_IMAGES)(self._read)

    def pairs(self) -> PairIndices:
        """Likely pairs, or all."""
        choose = all_pairs if self._options.candidates == "all" else likely_pairs
        return choose(self._references.map)

    def errors(self, u: int, v: int) -> PairErrors:
        """Localize u and v from each other."""
        return PairErrors(v_from_u=self.error(u, v), u_from_v=self.error(v, u))

    def error(self, reference: int, query: int) -> float:
        """Relative corner error of the query's pose, estimated from the reference alone."""
        seen = self._query(query)
        matches = self._matching.match(seen, reference, None)
        return self._references.error(query, matches.pixels(seen), matches.points)

    def _read(self, index: int) -> Query:
        map_, name = self._references.map, self._references.names[index]
        features = map_.features[name]
        return Query(
            keypoints=features.keypoints.astype(np.float64),
            descriptors=unit_rows(features.descriptors),
            features=features,
            camera=map_.camera(name),
            image=map_.photos.get(name),
        )
