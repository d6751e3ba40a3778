"""Match the query against each reference image: slow, and what all others must equal."""

import numpy as np
import pycolmap
from jaxtyping import Int64

from slimsfm.localization.references import References
from slimsfm.localization.strategy import MatchingOptions, Query, Rounds, Target
from slimsfm.mapping.map import Map


class Exhaustive:
    """Matches against all reference images. O(references x keypoints x points seen) a query."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        self._references = References(map, options)

    def rounds(self, query: Query) -> Rounds:
        """Match the query with every reference image, in one round."""
        yield self._references.match(query)

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """What a reference image near the pose sees."""
        return self._references.visible_points(cam_from_world, agreeing)
