"""One way to make a map small: what it keeps, what that weighs and what it is predicted to do."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slimsfm.arrays import Ids
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.map import Map, PointDescriptors
from slimsfm.mapping.subset import direct_map, keep_images
from slimsfm.reduction.forecast import Prediction

DOMINATING = "dominating"
"""The method that keeps a dominating set of the images."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """What is kept of a map."""

    use: str
    """How queries are to be matched with it: "direct" or "images"."""

    method: str
    """Who chose: a selector of points, or "dominating" for a dominating set of images."""

    detail: str
    """What the method was asked for."""

    images: tuple[str, ...]
    """The reference images that are kept for matching; none where points are matched directly."""

    points: Ids
    """Rows of the points that are kept, ascending."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A choice and what is known of it."""

    choice: Choice
    """The choice."""

    bytes: int
    """Size of its map on disk."""

    prediction: Prediction
    """How references that are left out are localized with it."""

    full: Prediction
    """How the full map localizes the same ones."""

    @cached_property
    def losses(self) -> tuple[float, ...]:
        """Percentage points lost against the full map within each of `ADD_FRACTIONS`; negative is a gain."""
        return tuple(self.full.within(one) - self.prediction.within(one) for one in ADD_FRACTIONS)

    @property
    def loss(self) -> float:
        """The largest of the losses."""
        return max(self.losses)

    @property
    def seconds(self) -> float:
        """Predicted time of matching and pose a query."""
        return self.prediction.seconds


class Maker:
    """Makes the maps of choices."""

    def __init__(self, map: Map) -> None:
        self._map = map

    def make(self, choice: Choice) -> Map:
        """The map that keeps what was chosen."""
        if choice.use == "images":
            return keep_images(self._map, choice.images)
        return direct_map(self._map, self.described(choice.points))

    def described(self, points: Ids) -> PointDescriptors:
        """Points with their descriptors."""
        return self._described[points]

    @cached_property
    def _described(self) -> PointDescriptors:
        return describe_points(self._map)


def points_seen(map: Map, images: tuple[str, ...]) -> Ids:
    """Rows of the points that some images see: the paper's P', ascending."""
    return np.unique(np.concatenate([map.observations[name].points for name in images]))
