"""The columns of the table, for all who print it."""

from collections.abc import Callable
from dataclasses import dataclass

from slimsfm.evaluation.metrics import DEG_CM, SURE
from slimsfm.geometry import ADD_FRACTIONS


@dataclass(frozen=True)
class Column:
    """A column of the table."""

    title: str
    """Its header."""

    meaning: str
    """Its header at length."""

    key: str
    """Name of its value in `Row.to_json`."""

    show: Callable[[float], str]
    """How a value is written."""


def number(value: float | int) -> str:
    """A count, or a mean of counts, with its thousands marked."""
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:,.1f}"


def size(num_bytes: float | int) -> str:
    """A size on disk in the unit that suits it; 1 kB is 1000 bytes."""
    value, units = float(num_bytes), ["B", "kB", "MB", "GB"]
    while value >= 999.5 and len(units) > 1:
        value, units = value / 1000, units[1:]
    return f"{value:.1f} {units[0]}" if value < 10 and units[0] != "B" else f"{value:.0f} {units[0]}"


def decimal(value: float | int) -> str:
    """A value with one digit after the point."""
    return f"{value:.1f}"


def _percent(value: float | int) -> str:
    return f"{100 * value:.1f}"


def _percent_of_d(value: float | int) -> str:
    return f"{100 * value:.2f} %"


MAP = (
    Column("Images", "reference images of the map", "references", number),
    Column("Points", "3D points of the map", "points", number),
    Column("Map size", "size of the map on disk", "map_bytes", size),
)

METRIC = tuple(
    Column(f"{n}°-{n}cm", f"% of queries within {n}° and {n} cm", f"{n}deg_{n}cm", decimal) for n in DEG_CM
)

ADD = tuple(
    Column(
        f"ADD-{share}d",
        f"% of queries with a mean box corner error below {share} of the diagonal d",
        f"add_{share}d",
        decimal,
    )
    for share in ADD_FRACTIONS
)

ERROR = (Column("Median error", "median error, in % of d", "median_error", _percent_of_d),)

TRUST = (
    Column(
        "Wrong when sure",
        "% beyond 0.1 of the diagonal among poses with confidence over 0.9",
        f"confidence_wrong_at_{SURE}",
        _percent,
    ),
    Column(
        "Tried", "reference images that a query was matched with, on average", "references_tried", decimal
    ),
)

STAGES = (
    Column("Extract ms", "milliseconds a query: its features", "ms_extract", decimal),
    Column("Match ms", "milliseconds a query: matching", "ms_match", decimal),
    Column("Pose ms", "milliseconds a query: pose search", "ms_pose", decimal),
)

FPS = (Column("FPS", "queries a second, all stages together", "fps", decimal),)


def columns(*, metric: bool) -> tuple[Column, ...]:
    """All of them; those in centimetres only where the unit is known."""
    return (*MAP, *(METRIC if metric else ()), *ADD, *ERROR, *TRUST, *STAGES, *FPS)


def paper_columns(*, metric: bool) -> tuple[Column, ...]:
    """Those of the paper's table, after the size of the map."""
    return (*MAP, *(METRIC if metric else ()), ADD[0], *FPS)


def brief_columns(*, metric: bool) -> tuple[Column, ...]:
    """Those that a terminal has room for: the paper's, stricter accuracy, and the time of each stage."""
    return (*MAP, *(METRIC if metric else ()), *ADD, *STAGES, *FPS)
