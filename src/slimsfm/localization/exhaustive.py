"""Match the query against each reference image and unite the matches.

Of a reference only the keypoints that see a point of the map take part: a match to any other gives the pose
nothing.
"""

from slimsfm.arrays import Descriptors, IndexPairs
from slimsfm.features import NearestOptions, match_nearest, unit_rows
from slimsfm.localization.strategy import PointMatches, unite
from slimsfm.mapping.map import Map, check_has_features


class Exhaustive:
    """Matches against all reference images. O(references x keypoints x points seen) a query."""

    def __init__(self, map: Map, matching: NearestOptions = NearestOptions()) -> None:
        check_has_features(map)
        self._matching = matching
        self._references = [
            (unit_rows(map.features[name].descriptors[seen.rows]), seen.points)
            for name, seen in map.observations.items()
        ]

    def match(self, descriptors: Descriptors) -> PointMatches:
        """Match the query's descriptors against those of every reference image."""
        parts: list[IndexPairs] = []
        for reference_descriptors, points in self._references:
            pairs = match_nearest(descriptors, reference_descriptors, self._matching)
            pairs[:, 1] = points[pairs[:, 1]]
            parts.append(pairs)
        return unite(parts)
