"""Match the query against each reference image and unite the matches.

Of a reference only the keypoints that see a point of the map take part: a match to any other gives the pose
nothing.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int64

from slimsfm.arrays import Descriptors, IndexPairs
from slimsfm.features import NearestOptions, match_nearest, unit_rows
from slimsfm.localization.strategy import PointMatches, unite
from slimsfm.mapping.map import Map, check_has_features

Target = tuple[Float32[np.ndarray, "_ d"], Int64[np.ndarray, " _"]]
"""Descriptors to match a query with, and the point of each; one target has more than another."""


class Exhaustive:
    """Matches against all reference images. O(references x keypoints x points seen) a query."""

    def __init__(self, map: Map, matching: NearestOptions = NearestOptions()) -> None:
        check_has_features(map)
        self._matching = matching
        self._references = [reference_target(map, name) for name in map.observations]

    def match(self, descriptors: Descriptors) -> PointMatches:
        """Match the query's descriptors against those of every reference image."""
        return match_targets(descriptors, self._references, self._matching)


def reference_target(map: Map, name: str) -> Target:
    """What to match of a reference image: its keypoints that see a point of the map."""
    seen = map.observations[name]
    return unit_rows(map.features[name].descriptors[seen.rows]), seen.points


def match_targets(
    descriptors: Descriptors, targets: Sequence[Target], matching: NearestOptions = NearestOptions()
) -> PointMatches:
    """Match a query's descriptors against one target after the other and unite the matches."""
    parts: list[IndexPairs] = []
    for target_descriptors, points in targets:
        pairs = match_nearest(descriptors, target_descriptors, matching)
        pairs[:, 1] = points[pairs[:, 1]]
        parts.append(pairs)
    return unite(parts)
