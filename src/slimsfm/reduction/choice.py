"""Choices of what to keep, what each is predicted to do, and the limits by which one is recommended."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from slimsfm.arrays import Ids
from slimsfm.errors import InputError
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.map import Map, PointDescriptors
from slimsfm.mapping.subset import direct_map, keep_images
from slimsfm.reduction.forecast import Prediction

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

    @property
    def seconds(self) -> float:
        """Predicted time of matching and pose per query."""
        return self.prediction.seconds


@dataclass(frozen=True, kw_only=True, eq=False)
class Frontier:
    """The choices that were tried on a map."""

    full: Prediction
    """How the full map, matched image by image, localizes references that are left out."""

    candidates: tuple[Candidate, ...]
    """The choices with their sizes and predictions, by use and method."""

    bytes: int
    """Size of the full map on disk."""

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
    return direct_map(map, described[choice.points])


def points_seen(map: Map, images: tuple[str, ...]) -> Ids:
    """Rows of the points that some images see, ascending: P' in the paper."""
    return np.unique(np.concatenate([map.observations[name].points for name in images]))


_RESERVE = 2.0  # times the points of the smallest candidate that loses nothing
_ROUGH_LOSS = 2.0  # percentage points: forecasts are a few points too optimistic, and 5 may be lost
_LEAST_FACTOR = 50  # a reserve for rough queries leaves the map so many times smaller than the full one
_TINY = 1e-9


@dataclass(frozen=True, kw_only=True)
class ReductionLimits:
    """Limits of a reduced map; the smallest candidate within them is taken."""

    max_loss: float | None = None
    """Largest loss against the full map within each of 0.1, 0.05 and 0.02 d, in percentage points, and within
    0.1 d on rough queries if these are predicted; None: the least possible, with a reserve."""

    max_bytes: float | None = None
    """Largest size of the map on disk, in bytes."""

    max_ms: float | None = None
    """Longest time of matching and pose per query on this machine, in milliseconds."""

    max_points: int | None = None
    """Largest number of points."""

    max_images: int | None = None
    """Largest number of images, where images are kept."""

    def __post_init__(self) -> None:
        for name, value in self.given.items():
            if not value >= 0:
                raise ValueError(f"{name} must not be negative, got {value}")

    @property
    def given(self) -> dict[str, int | float]:
        """The limits that are set, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def __str__(self) -> str:
        return ", ".join(f"{name} {value:g}" for name, value in self.given.items())


def recommend(frontier: Frontier, use: str, limits: ReductionLimits = ReductionLimits()) -> Candidate:
    """Take the smallest candidate for a use that meets the limits.

    Without `max_loss`, the smallest candidate that loses nothing on the references is replaced by one of the
    same method with twice as many points, if there is one: queries resemble the references less than these
    resemble each other. If every candidate loses something, the one that loses least is taken.

    If rough queries were predicted, and that choice loses more than 2 points on them, it is replaced by the
    smallest one that neither does that nor loses more on clean queries. Such a map has at most a fiftieth of
    the full map's bytes; if none of this size suffices, the one that loses least on rough queries is taken.

    Raises:
        InputError: No candidate meets the limits.
    """
    usable = [one for one in frontier.candidates if _is_usable(one.choice, use) and one.prediction.tests]
    if not usable:
        raise InputError(f"there is no way to reduce this map for {use}")
    fitting = [one for one in usable if _excess(_figures(one), limits) <= 0]
    if not fitting:
        nearest = min(usable, key=lambda one: (_excess(_figures(one), limits), _size(one)))
        raise InputError(
            f"{_refusal(nearest.choice, nearest.bytes, limits)}, loses {nearest.loss:.1f} points"
            f"{_rough(nearest)} and takes {1e3 * nearest.seconds:.2g} ms"
        )
    if limits.max_loss is not None:
        return min(fitting, key=_size)
    least = max(min(one.loss for one in fitting), 0.0)
    lossless = [one for one in fitting if one.loss <= least]
    reserved = _with_reserve(min(lossless, key=_size), fitting)
    return _for_rough(reserved, lossless, frontier.bytes / _LEAST_FACTOR)


def check_reachable(
    choices: Sequence[Choice], sizes: Sequence[int], use: str, limits: ReductionLimits
) -> None:
    """Refuse limits that no choice can meet, before anything is predicted.

    Args:
        choices: The choices that would be predicted.
        sizes: The bytes of their maps.
        use: "direct" or "images".
        limits: The limits; those on loss and time are not checked here.

    Raises:
        InputError: No choice for the use meets the limits; the nearest one is named.
    """
    usable = [pair for pair in zip(choices, sizes, strict=True) if _is_usable(pair[0], use)]
    excesses = [_excess(_weights(*pair), limits) for pair in usable]
    if usable and min(excesses) > 0:
        nearest = usable[excesses.index(min(excesses))]
        raise InputError(_refusal(*nearest, limits))


def _is_usable(choice: Choice, use: str) -> bool:
    """Whether a choice may be taken: the points of a dominating set are only listed for comparison."""
    return choice.use == use and (use, choice.method) != ("direct", DOMINATING)


def _weights(choice: Choice, size: int) -> dict[str, int | float]:
    return {"max_bytes": size, "max_points": len(choice.points), "max_images": len(choice.images)}


def _figures(one: Candidate) -> dict[str, int | float]:
    return {
        **_weights(one.choice, one.bytes),
        "max_loss": max((one.loss, *one.rough_losses)),
        "max_ms": 1e3 * one.seconds,
    }


def _excess(figures: dict[str, int | float], limits: ReductionLimits) -> float:
    """By how much figures exceed the limits, the worst one counted: 0 or less where all limits are met."""
    excesses = [0.0]
    for name, limit in limits.given.items():
        if figures.get(name, limit) > limit:
            unit = 1.0 if name == "max_loss" else _TINY
            excesses.append((figures[name] - limit) / max(limit, unit))
    return max(excesses)


def _size(one: Candidate) -> tuple[int, int, float]:
    """Fewer images and points first; among equals the more accurate."""
    return len(one.choice.images), len(one.choice.points), one.prediction.median_error


def _with_reserve(smallest: Candidate, fitting: list[Candidate]) -> Candidate:
    enough = _RESERVE * len(smallest.choice.points)
    larger = [
        one
        for one in fitting
        if one.choice.method == smallest.choice.method
        and len(one.choice.points) >= enough
        and one.choice.use == "direct"
    ]
    return min(larger, key=_size, default=smallest)


def _rough(one: Candidate) -> str:
    return "" if one.rough_loss is None else f" ({one.rough_loss:.1f} on rough queries)"


def _for_rough(reserved: Candidate, lossless: list[Candidate], most_bytes: float) -> Candidate:
    """The candidate with a reserve, or a larger one if it loses too much on rough queries."""
    if _rough_excess(reserved) == 0:
        return reserved
    larger = [
        one
        for one in lossless
        if len(one.choice.points) > len(reserved.choice.points) and one.bytes <= most_bytes
    ]
    return min([reserved, *larger], key=lambda one: (_rough_excess(one), _size(one)))


def _rough_excess(one: Candidate) -> float:
    return max((one.rough_loss or 0.0) - _ROUGH_LOSS, 0.0)


def _refusal(nearest: Choice, size: int, limits: ReductionLimits) -> str:
    images = f"{len(nearest.images)} images, " if nearest.images else ""
    return (
        f"no choice for {nearest.use} meets {limits}; the nearest, {nearest.method} ({nearest.detail}), "
        f"has {images}{len(nearest.points)} points and {size} bytes"
    )
