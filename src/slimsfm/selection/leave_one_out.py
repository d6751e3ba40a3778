"""The points of a map as described without one of its images."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float32

from slimsfm.arrays import Descriptors, Ids, Points2D
from slimsfm.features import unit_rows
from slimsfm.localization.point_descriptors import descriptor_sums
from slimsfm.mapping.map import Map

_CACHED = 64  # images whose descriptors are cached
_NOTHING_LEFT = 1e-3  # a sum of descriptors shorter than this is empty up to rounding errors


@dataclass(frozen=True, kw_only=True, eq=False)
class LeftOutImage:
    """An image that is left out of the map and serves as a query."""

    keypoints: Points2D
    """Pixels of its keypoints."""

    descriptors: Descriptors
    """Unit descriptor of each keypoint."""


class LeftOut:
    """Describes points by their observations in all images but one, so that this one can be a query."""

    def __init__(self, map: Map) -> None:
        self._map = map
        self._sums = descriptor_sums(map)
        self.query = lru_cache(maxsize=_CACHED)(self._query)

    def _query(self, name: str) -> LeftOutImage:
        features = self._map.features[name]
        return LeftOutImage(
            keypoints=features.keypoints.astype(np.float64), descriptors=unit_rows(features.descriptors)
        )

    def describe(self, points: Ids, name: str) -> Float32[np.ndarray, "n d"]:
        """Mean descriptors of points without the image; zeros, which match nothing, if no other sees them.

        Args:
            points: Rows of the map's points, ascending.
            name: The image that is left out.
        """
        sums = self._sums[points]
        own = self._map.observations[name]
        place = np.searchsorted(points, own.points).clip(max=len(points) - 1)
        seen = points[place] == own.points
        np.subtract.at(sums, place[seen], self.query(name).descriptors[own.rows[seen]])
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.where(lengths > _NOTHING_LEFT, sums / np.maximum(lengths, _NOTHING_LEFT), 0)
