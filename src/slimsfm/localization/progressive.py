"""Match the query with a few landmarks, then with one reference image after another, until the pose is sure.

Three things decide which image comes next: its similarity to the query (retrieval), how many of its points no
image tried so far sees (cover), and how many points that agree with the pose it sees. Cover limits what a
wrong start costs; agreement confirms a right one.
"""

import numpy as np
import pycolmap
from jaxtyping import Float32, Int64

from slimsfm.arrays import Ids
from slimsfm.features import unit_rows
from slimsfm.localization.matching import match_target
from slimsfm.localization.point_descriptors import descriptor_sums
from slimsfm.localization.reference_images import ImageRanking, ReferenceImages
from slimsfm.localization.strategy import MatchingOptions, Query, Rounds, Target, unite
from slimsfm.mapping.map import Map, observed

_FIRST, _STRONGEST = 1024, 2048  # keypoints matched with landmarks, and with images before the last round
_GROWTH = 0.6  # growth of the number of images from round to round, so that few poses are estimated
_TRIED = 0.5  # share of the images after which everything is matched with everything
_PER_IMAGE = 60  # landmarks that each image sees, if it sees as many points
_LANDMARKS = 1000  # landmarks per map, at most


class Progressive:
    """Matches with the most likely images first, and with all of them if the pose stays unsure."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        self._nearest = map.descriptor_metric
        self._references = ReferenceImages(map, options)
        self._ranking = ImageRanking(map)
        landmarks = choose_landmarks(map)
        self._landmarks = unit_rows(descriptor_sums(map))[landmarks], landmarks

    def rounds(self, query: Query) -> Rounds:
        """Match in rounds: the landmarks, one image, a second one, then more per round; last all with all."""
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
        """The most useful image not tried yet: in turn one to confirm the pose and one to refute it."""
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
        """The points that one reference image near the pose sees."""
        return self._references.visible_points(cam_from_world, agreeing)


def choose_landmarks(map: Map) -> Ids:
    """Choose a few points such that each reference image sees some of them.

    Takes the points with most observations first, until each image sees enough. Skips a point if all images
    that observe it see enough landmarks already. O(observations).

    Returns:
        Rows of the map's points, ascending.
    """
    seen_by = observed(map).T.tocsr()
    order = np.argsort(-np.diff(seen_by.indptr), kind="stable")
    counts = np.zeros(len(map.images), np.int64)
    chosen: list[int] = []
    for point in order.tolist():
        images = seen_by.indices[seen_by.indptr[point] : seen_by.indptr[point + 1]]
        if np.any(counts[images] < _PER_IMAGE):
            chosen.append(point)
            counts[images] += 1
            if len(chosen) == _LANDMARKS or counts.min() >= _PER_IMAGE:
                break
    return np.array(sorted(chosen), np.int64)
