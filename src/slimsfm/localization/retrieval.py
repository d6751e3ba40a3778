"""Match the query with the reference images that resemble it most, as hloc does [1].

References:
    [1] Sarlin, Cadena, Siegwart and Dymczyk, From Coarse to Fine: Robust Hierarchical Localization at Large
        Scale, CVPR 2019.
"""

import numpy as np
import pycolmap
from jaxtyping import Int64

from slimsfm.localization.ranking import Ranking
from slimsfm.localization.references import References
from slimsfm.localization.strategy import MatchingOptions, Query, Rounds, Target
from slimsfm.mapping.map import Map


class Retrieval:
    """Matches against a fixed number of reference images, those of most similar appearance."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        self._retrieved = options.retrieved
        self._references = References(map, options)
        self._ranking = Ranking(map)

    def rounds(self, query: Query) -> Rounds:
        """Match the query with the images that resemble it, in one round."""
        order = np.argsort(-self._ranking.similarities(self._references.describe(query)), kind="stable")
        yield self._references.match(query, order[: self._retrieved].tolist())

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """What a reference image near the pose sees."""
        return self._references.visible_points(cam_from_world, agreeing)
