"""Choices of what to keep of a map, and what each is predicted to do."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slimsfm.arrays import Ids
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.map import Map, PointDescriptors
from slimsfm.mapping.subset import direct_map, keep_images
from slimsfm.reduction.forecast import Prediction
from slimsfm.reduction.image_size import SizeTrials

DOMINATING = "dominating"
"""The method that keeps a dominating set of the images."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """The images or points of a map that are kept."""

    use: str
    """How queries are matched with the reduced map: "direct" (with points) or "images"."""

    method: str
    """The selector of the points, or "dominating", "images" or "random" for images."""

    detail: str
    """The request to the method, such as a number of points."""

    images: tuple[str, ...]
    """The reference images that are kept for matching; empty where points are matched directly."""

    points: Ids
    """Rows of the points that are kept, ascending."""


@dataclass(frozen=True, kw_only=True)
class ErrorGrowth:
    """How many times as large as with the full map the corner errors of the same queries are.

    Errors below `Prediction.finest_error` count as this error, so that a multiple of nearly nothing is no
    growth. A percentile that has a pose with neither map does not grow.
    """

    median: float
    """Factor of the median."""

    p90: float
    """Factor of the 90th percentile."""


def _factor(slim: float, full: float, floor: float) -> float:
    if slim == full or max(slim, full) <= floor:
        return 1.0
    return max(slim, floor) / max(full, floor)


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A choice with its size and its predicted effect."""

    choice: Choice
    """The images or points that are kept."""

    bytes: int
    """Size of the reduced map on disk."""

    prediction: Prediction
    """How the reduced map localizes references that are left out."""

    full: Prediction
    """How the full map localizes the same references."""

    sizes: SizeTrials | None = None
    """Tries image sizes for the queries; None if the extractor has no image size or no scales."""

    @cached_property
    def losses(self) -> tuple[float, ...]:
        """Percentage points lost against the full map within each of `ADD_FRACTIONS`; negative is a gain."""
        return tuple(self.full.within(one) - self.prediction.within(one) for one in ADD_FRACTIONS)

    @property
    def loss(self) -> float:
        """The largest of the losses on clean queries, in percentage points."""
        return max(self.losses)

    @cached_property
    def rough_losses(self) -> tuple[float, ...]:
        """Percentage points lost within 0.1 d after each disturbance; empty if none was tried."""
        full, slim = (one.rough_within(ADD_FRACTIONS[0]) for one in (self.full, self.prediction))
        return tuple(a - b for a, b in zip(full, slim, strict=True))

    @property
    def rough_loss(self) -> float | None:
        """The largest of the losses on disturbed queries, in percentage points; None if none was tried."""
        return max(self.rough_losses, default=None)

    @cached_property
    def growth(self) -> ErrorGrowth:
        """How many times as large as the full map's the corner errors are."""
        floor = self.full.finest_error
        return ErrorGrowth(
            median=_factor(self.prediction.median_error, self.full.median_error, floor),
            p90=_factor(self.prediction.p90_error, self.full.p90_error, floor),
        )

    @property
    def seconds(self) -> float:
        """Predicted time of a whole query, from decoded pixels to pose; NaN if extraction is not known."""
        return self.prediction.seconds.total


@dataclass(frozen=True, kw_only=True, eq=False)
class Frontier:
    """The choices that were tried on a map."""

    full: Prediction
    """How the full map, matched image by image, localizes references that are left out."""

    candidates: tuple[Candidate, ...]
    """The choices with their sizes and predictions, by use and method."""

    bytes: int
    """Size of the full map on disk."""

    diagonal: float
    """Diagonal of the map's box, in map units."""

    def is_pareto_dominated(self, one: Candidate) -> bool:
        """Whether another candidate for the same use is not larger, loses no more, and is better in one."""
        return any(
            other.choice.use == one.choice.use
            and (other.bytes, other.loss) != (one.bytes, one.loss)
            and other.bytes <= one.bytes
            and other.loss <= one.loss
            for other in self.candidates
        )


def apply_choice(map: Map, choice: Choice, *, described: PointDescriptors | None = None) -> Map:
    """Create the reduced map that keeps a choice.

    Args:
        map: The full map.
        choice: The images or points to keep.
        described: `describe_points(map)`, if the caller has computed it; used for direct matching only.
    """
    if choice.use == "images":
        return keep_images(map, choice.images)
    described = describe_points(map) if described is None else described
    return direct_map(map, described.of(choice.points))


def points_seen(map: Map, images: tuple[str, ...]) -> Ids:
    """Rows of the points that some images see, ascending: P' in the paper."""
    return np.unique(np.concatenate([map.observations[name].points for name in images]))
