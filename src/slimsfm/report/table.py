"""The paper's table as HTML: a click on a header sorts it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from slimsfm.evaluation.metrics import ADD_FRACTIONS, DEG_CM, SURE
from slimsfm.evaluation.table import Row
from slimsfm.report.words import number, size


@dataclass(frozen=True)
class Column:
    """A column of the table."""

    title: str
    """Its header."""

    meaning: str
    """Its header at length, shown when pointed at."""

    key: str
    """Name of its value in `Row.to_json`."""

    show: Callable[[float], str]
    """How a value is written."""


def _decimal(value: float) -> str:
    return f"{value:.1f}"


def _percent(value: float) -> str:
    return f"{100 * value:.1f}"


def _percent_of_d(value: float) -> str:
    return f"{100 * value:.2f} %"


_MAP = (
    Column("Images", "reference images of the map", "references", number),
    Column("Points", "3D points of the map", "points", number),
    Column("Map size", "size of the map on disk", "map_bytes", size),
)

_METRIC = tuple(
    Column(f"{n}°-{n}cm", f"% of queries within {n}° and {n} cm", f"{n}deg_{n}cm", _decimal) for n in DEG_CM
)

_RELATIVE = (
    *(
        Column(
            f"ADD-{share}d",
            f"% of queries with a mean box corner error below {share} of the diagonal d",
            f"add_{share}d",
            _decimal,
        )
        for share in ADD_FRACTIONS
    ),
    Column("Median error", "median corner error, in % of d", "median_corner_error", _percent_of_d),
)

_TRUST = (
    Column(
        "Wrong when sure",
        "% beyond 0.1 of the diagonal among poses with confidence over 0.9",
        f"confidence_wrong_at_{SURE}",
        _percent,
    ),
    Column(
        "Tried", "reference images that a query was matched with, on average", "references_tried", _decimal
    ),
)

_SPEED = (
    Column("Extract ms", "milliseconds a query: its features", "ms_extract", _decimal),
    Column("Match ms", "milliseconds a query: matching", "ms_match", _decimal),
    Column("Pose ms", "milliseconds a query: pose search", "ms_pose", _decimal),
    Column("FPS", "queries a second, all stages together", "fps", _decimal),
)


def table_html(rows: Sequence[Row]) -> str:
    """The rows as a table; what has no value shows as a dash and sorts last."""
    metric = any(row.scores.deg_cm is not None for row in rows)
    columns = (*_MAP, *(_METRIC if metric else ()), *_RELATIVE, *_TRUST, *_SPEED)
    heads = [_head("Strategy", "how queries are matched"), _head("Map", "which variant of the map")]
    heads += [_head(column.title, column.meaning) for column in columns]
    lines = "\n".join(f"<tr>{_cells(row, columns)}</tr>" for row in rows)
    head = f"<thead><tr>{''.join(heads)}</tr></thead>"
    return f'<div class="scroll"><table>{head}\n<tbody>{lines}</tbody></table></div>'


def _head(title: str, meaning: str) -> str:
    return f'<th scope="col" title="{escape(meaning)}"><button>{escape(title)}</button></th>'


def _cells(row: Row, columns: Sequence[Column]) -> str:
    values = row.to_json()
    texts = "".join(f"<td>{escape(text)}</td>" for text in (row.strategy, row.variant))
    return texts + "".join(_cell(values.get(column.key), column.show) for column in columns)


def _cell(value: float | None, show: Callable[[float], str]) -> str:
    if value is None:
        return '<td class="number">&ndash;</td>'
    return f'<td class="number" data-value="{value:.9g}">{escape(show(value))}</td>'
