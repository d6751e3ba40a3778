"""Which of a frontier's candidates to take."""

from dataclasses import dataclass

from slimsfm.errors import InputError
from slimsfm.reduction.choice import DOMINATING, Candidate
from slimsfm.reduction.frontier import Frontier

_RESERVE = 2.0  # times the points that just lose nothing


_LIMITS = ("max_loss", "max_bytes", "max_ms", "max_points", "max_images")


@dataclass(frozen=True, kw_only=True)
class Wish:
    """What a reduced map must keep to."""

    max_loss: float | None = None
    """Percentage points that may be lost against the full map, within 0.1, 0.05 and 0.02 d alike; None: as
    few as can be, with a reserve."""

    max_bytes: float | None = None
    """Size of the map on disk."""

    max_ms: float | None = None
    """Time of matching and pose a query, on this machine."""

    max_points: int | None = None
    """Points that are kept."""

    max_images: int | None = None
    """Images that are kept, where images are matched."""

    def __post_init__(self) -> None:
        for name in _LIMITS:
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ValueError(f"{name} must not be negative, got {value}")


def recommend(frontier: Frontier, use: str, wish: Wish = Wish()) -> Candidate:
    """Take the smallest candidate that keeps to the wish.

    Without a largest loss, the smallest that loses nothing on the references gives way to one of its method
    with twice as many points: queries are less like the references than those are like each other. Where
    every candidate loses something, the one that loses least is taken.

    Raises:
        InputError: No candidate keeps to the wish.
    """
    usable = [one for one in frontier.candidates if one.choice.use == use and _is_usable(one)]
    fitting = [one for one in usable if _fits(one, wish)]
    if not fitting:
        raise InputError(_refusal(usable, use, wish))
    if wish.max_loss is not None:
        return min(fitting, key=_size)
    least = max(min(one.loss for one in fitting), 0.0)
    smallest = min((one for one in fitting if one.loss <= least), key=_size)
    return _with_reserve(smallest, fitting)


def _is_usable(one: Candidate) -> bool:
    """Whether it was tested, and is not the points of a dominating set: those are listed to be compared."""
    choice = one.choice
    return len(one.prediction.tests) > 0 and (choice.use, choice.method) != ("direct", DOMINATING)


def _fits(one: Candidate, wish: Wish) -> bool:
    return (
        (wish.max_loss is None or one.loss <= wish.max_loss)
        and (wish.max_bytes is None or one.bytes <= wish.max_bytes)
        and (wish.max_ms is None or 1e3 * one.seconds <= wish.max_ms)
        and (wish.max_points is None or len(one.choice.points) <= wish.max_points)
        and (wish.max_images is None or len(one.choice.images) <= wish.max_images)
    )


def _size(one: Candidate) -> tuple[int, int, float]:
    """What is small goes first; of as many images and points, what is accurate."""
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


def _refusal(usable: list[Candidate], use: str, wish: Wish) -> str:
    asked = ", ".join(
        f"{name.replace('_', '-')} {getattr(wish, name):g}"
        for name in _LIMITS
        if getattr(wish, name) is not None
    )
    if not usable:
        return f"there is no way to reduce this map for {use}"
    least, smallest = min(usable, key=lambda one: one.loss), min(usable, key=_size)
    fastest = min(usable, key=lambda one: one.seconds)
    return (
        f"no choice for {use} meets {asked}; the least loss is {least.loss:.1f} % with {least.bytes} bytes, "
        f"the smallest has {smallest.bytes} bytes, the fastest takes {1e3 * fastest.seconds:.2g} ms; "
        "`slimsfm frontier` lists all"
    )
