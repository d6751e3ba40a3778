"""Limits of a reduced map, and the candidate that is recommended within them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import isfinite

from slimsfm.errors import InputError
from slimsfm.reduction.choice import DOMINATING, Candidate, Choice, ErrorGrowth, Frontier

_RESERVE = 2.0  # times the points of the smallest candidate that loses nothing
_ROUGH_LOSS = 2.0  # percentage points: forecasts are a few points too optimistic, and 5 may be lost
_LEAST_FACTOR = 50  # exactness and rough queries leave the map so many times smaller than the full one
_TINY = 1e-9
_MEDIAN_FACTOR, _P90_FACTOR = 1.5, 2.0  # by which corner errors may grow, where nothing else is asked for
_ANY = float("inf")


@dataclass(frozen=True, kw_only=True)
class ReductionLimits:
    """Limits of a reduced map; the smallest candidate within them is taken."""

    max_loss: float | None = None
    """Largest loss against the full map within each of 0.1, 0.05 and 0.02 d, in percentage points, and within
    0.1 d on rough queries if these are predicted; None: the least possible, with a reserve."""

    max_median_factor: float | None = None
    """How many times as large as the full map's the median corner error may be; None: 1.5 if possible, unless
    `max_loss` or a largest error is given."""

    max_p90_factor: float | None = None
    """The same for the 90th percentile of the corner error; None: 2, as above."""

    max_error: float | None = None
    """Largest corner error in map units: the 90th percentile that is predicted."""

    max_relative_error: float | None = None
    """Largest corner error over the diagonal of the box: the 90th percentile that is predicted."""

    max_bytes: float | None = None
    """Largest size of the map on disk, in bytes."""

    max_ms: float | None = None
    """Longest time of a whole query on this machine, from decoded pixels to pose, in milliseconds."""

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

    @property
    def aims(self) -> tuple[float, float]:
        """Factors of the median and the 90th percentile to stay within if possible; infinite: any."""
        if {"max_loss", "max_error", "max_relative_error"} & self.given.keys():
            return _ANY, _ANY
        return (
            _MEDIAN_FACTOR if self.max_median_factor is None else _ANY,
            _P90_FACTOR if self.max_p90_factor is None else _ANY,
        )

    def __str__(self) -> str:
        said = {name: (name, f"{value:g}") for name, value in self.given.items()}
        if self.max_relative_error is not None:
            said["max_relative_error"] = ("max_error", f"{self.max_relative_error:g}d")
        return ", ".join(" ".join(one) for one in said.values())


def recommend(frontier: Frontier, use: str, limits: ReductionLimits = ReductionLimits()) -> Candidate:
    """Take the smallest candidate for a use that meets the limits.

    Without `max_loss`, the smallest candidate that loses nothing on the references is replaced by one of the
    same method with twice as many points, if there is one: queries resemble the references less than these
    resemble each other. If every candidate loses something, the one that loses least is taken.

    If its corner errors grow by more than `ReductionLimits.aims`, it is replaced by the smallest larger one
    that loses no more and stays within them, or by the one that exceeds them least.

    If rough queries were predicted, and that choice loses more than 2 points on them, it is replaced by the
    smallest larger one that does not and is as good otherwise, or by the one that loses least on them.

    Neither makes a map larger than a fiftieth of the full map's bytes.

    Raises:
        InputError: No candidate meets the limits.
    """
    usable = [one for one in frontier.candidates if _is_usable(one.choice, use) and one.prediction.tests]
    if not usable:
        raise InputError(f"there is no way to reduce this map for {use}")
    excesses = [_excess(_figures(one, frontier.diagonal), limits) for one in usable]
    fitting = [one for one, excess in zip(usable, excesses, strict=True) if excess <= 0]
    if not fitting:
        _, nearest = min(zip(excesses, usable, strict=True), key=lambda pair: (pair[0], _size(pair[1])))
        raise InputError(f"{_refusal(nearest.choice, nearest.bytes, limits)}, {_effect(nearest)}")
    if limits.max_loss is not None:
        return min(fitting, key=_size)
    least = max(min(one.loss for one in fitting), 0.0)
    lossless = [one for one in fitting if one.loss <= least]
    reserved = _with_reserve(min(lossless, key=_size), fitting)
    small = [one for one in lossless if one.bytes <= frontier.bytes / _LEAST_FACTOR]
    exact = _most_exact([reserved, *_larger(reserved, small)], limits.aims)
    best = min(exact, key=_size)
    return min([best, *_larger(best, exact)], key=lambda one: (_rough_excess(one), _size(one)))


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


def _figures(one: Candidate, diagonal: float) -> dict[str, int | float]:
    return {
        **_weights(one.choice, one.bytes),
        "max_loss": max((one.loss, *one.rough_losses)),
        "max_median_factor": one.growth.median,
        "max_p90_factor": one.growth.p90,
        "max_error": one.prediction.p90_error * diagonal,
        "max_relative_error": one.prediction.p90_error,
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


def _effect(one: Candidate) -> str:
    rough = "" if one.rough_loss is None else f" ({one.rough_loss:.1f} on rough queries)"
    time = (
        f", and takes {1e3 * one.seconds:.3g} ms, {1e3 * one.prediction.seconds.extract:.3g} for extraction"
    )
    return (
        f"loses {one.loss:.1f} points{rough}, has a corner error of {one.prediction.p90_error:.2g}d (90th "
        f"percentile), {one.growth.p90:.2g} times the full map's{time if isfinite(one.seconds) else ''}"
    )


def _larger(than: Candidate, candidates: list[Candidate]) -> list[Candidate]:
    return [one for one in candidates if len(one.choice.points) > len(than.choice.points)]


def _most_exact(candidates: list[Candidate], aims: tuple[float, float]) -> list[Candidate]:
    """The candidates whose corner errors are within the aims, or exceed them least."""
    excesses = [_growth_excess(one.growth, aims) for one in candidates]
    least = min(excesses)
    return [one for one, excess in zip(candidates, excesses, strict=True) if excess == least]


def _growth_excess(growth: ErrorGrowth, aims: tuple[float, float]) -> float:
    """How many times as large as its aim the worse factor is; 1 if both are within."""
    pairs = zip((growth.median, growth.p90), aims, strict=True)
    return max((factor / aim for factor, aim in pairs if factor > aim), default=1.0)


def _rough_excess(one: Candidate) -> float:
    return max((one.rough_loss or 0.0) - _ROUGH_LOSS, 0.0)


def _refusal(nearest: Choice, size: int, limits: ReductionLimits) -> str:
    images = f"{len(nearest.images)} images, " if nearest.images else ""
    return (
        f"no choice for {nearest.use} meets {limits}; the nearest, {nearest.method} ({nearest.detail}), "
        f"has {images}{len(nearest.points)} points and {size} bytes"
    )
