"""Match the query with a few landmarks, then one reference image after the other, until the pose is sure.

Which image comes next is decided by three things: what resembles the query (retrieval), what sees points that
the images tried so far do not (cover), and what sees the points that agree with what was found so far. The
second makes a wrong start cheap, the third confirms a right one.
"""

import numpy as np
import pycolmap
from jaxtyping import Float32, Int64

from slimsfm.arrays import Ids
from slimsfm.localization.landmarks import choose_landmarks
from slimsfm.localization.matching import match_target
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.localization.ranking import Ranking
from slimsfm.localization.references import References
from slimsfm.localization.strategy import MatchingOptions, Query, Rounds, Target, unite
from slimsfm.mapping.map import Map

_FIRST, _STRONGEST = 1024, 2048  # keypoints matched with landmarks, and with images before everything is
_GROWTH = 0.6  # by which the number of images tried grows from round to round: few poses are estimated
_TRIED = 0.5  # share of the images after which everything is matched with everything


class Progressive:
    """Matches with what promises most, then with ever more; with all reference images when unsure."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        self._nearest = map.descriptor_metric
        self._references = References(map, options)
        self._ranking = Ranking(map)
        landmarks = describe_points(map)[choose_landmarks(map)]
        self._landmarks = landmarks.descriptors, landmarks.points

    def rounds(self, query: Query) -> Rounds:
        """Match in rounds: the landmarks, one image, another, then ever more; last all with all."""
        parts = [match_target(query.descriptors[:_FIRST], self._landmarks, self._nearest)]
        matches = unite(parts)
        pose = yield matches
        similarities, tried = self._ranking.similarities(self._references.describe(query)), []
        while len(tried) < _TRIED * len(self._references):
            agreeing = matches.points[pose.inliers] if pose else matches.points
            for _ in range(max(1, round(_GROWTH * len(tried)))):
                tried.append(self._next(similarities, tried, agreeing))
                parts.append(self._references.match(query, tried[-1:], _STRONGEST))
            matches = unite(parts)
            pose = yield matches
        yield self._references.match(query)

    def _next(self, similarities: Float32[np.ndarray, " references"], tried: list[int], agreeing: Ids) -> int:
        """The image that promises most of those not tried: in turn one to confirm and one to refute."""
        score = similarities.copy()
        if len(tried) % 2 == 0 and len(agreeing):
            score += self._references.sharing(agreeing) / len(agreeing)
        elif tried:
            score -= self._references.known_from(tried)
        score[tried] = -np.inf
        return int(score.argmax())

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """What a reference image near the pose sees."""
        return self._references.visible_points(cam_from_world, agreeing)
