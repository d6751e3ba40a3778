"""Match the query against points of the map, each described by the mean of its observations [1].

The strongest keypoints of a query are matched first. If they give a sure pose, the many weak ones are not
matched at all.

References:
    [1] Sattler, Leibe and Kobbelt, Fast Image-based Localization using Direct 2D-to-3D Matching, ICCV 2011.
"""

import numpy as np
import pycolmap
from jaxtyping import Int64

from slimsfm.localization.matching import match_target
from slimsfm.localization.point_descriptors import mean_descriptors
from slimsfm.localization.strategy import MatchingOptions, Query, Rounds, Target, unite
from slimsfm.mapping.map import Map

_STRONGEST = (1024,)  # keypoints per round before the last, which takes all
_NARROWEST = 0.5  # cosine: a point may be visible 60 degrees away from where it was seen


class Direct:
    """Matches against all described points at once. O(keypoints x points) per query."""

    requires = "points"

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:  # noqa: ARG002
        self._nearest = map.descriptor_metric
        self._described = map.point_descriptors or mean_descriptors(map)
        self._positions = map.points3D_in_world[self._described.points].astype(np.float32)
        self._target = self._described.descriptors, self._described.points

    def rounds(self, query: Query) -> Rounds:
        """Match the strongest keypoints with the points' mean descriptors, then all keypoints."""
        counts = [count for count in _STRONGEST if count < len(query.descriptors)]
        for count in (*counts, len(query.descriptors)):
            yield unite([match_target(query.descriptors[:count], self._target, self._nearest)])

    def visible_points(
        self,
        cam_from_world: pycolmap.Rigid3d,
        agreeing: Int64[np.ndarray, " _"] | None = None,  # noqa: ARG002
    ) -> Target:
        """The points that were seen from about the position of the camera.

        The mean of unit vectors spread over a cone has the length (1 + cosine of the half angle) / 2, so the
        length of a point's direction gives the range of angles it was seen from.
        """
        if self._described.directions is None:
            return self._target
        towards = cam_from_world.inverse().translation.astype(np.float32) - self._positions
        lengths = np.linalg.norm(self._described.directions, axis=1)
        least = np.minimum(_NARROWEST, 2 * lengths - 1)
        products = np.einsum("nd,nd->n", towards, self._described.directions)
        facing = np.flatnonzero(products >= least * lengths * np.linalg.norm(towards, axis=1))
        return self._described.descriptors[facing], self._described.points[facing]
