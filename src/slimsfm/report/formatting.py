"""How the report writes counts, ratios, comparisons and tables, as text and as HTML."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from math import isfinite

from slimsfm.evaluation.comparison import Comparison, MeasurementKey
from slimsfm.evaluation.formats import format_p_value, is_metric
from slimsfm.evaluation.results import MappedObject
from slimsfm.evaluation.table import Column, Row, all_columns, format_number
from slimsfm.mapping.map import Map

_EQUAL = "1.0"
_STEMS = {"smaller": "small", "larger": "large", "faster": "fast", "slower": "fast"}
_MARKED = ' class="marked"'
_FILTER_ROWS = 12  # tables with more rows get a filter


def format_count(count: int, noun: str) -> str:
    """A count and its noun, in the format_count where the count is not 1."""
    nouns = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{format_number(count)} {noun if count == 1 else nouns}"


def format_map(map: Map) -> str:
    """Number of images and points of a map."""
    points = format_count(len(map.point3D_ids), "point")
    return points if map.is_for_direct_matching else f"{format_count(len(map.images), 'image')}, {points}"


def format_line(key: MeasurementKey, methods: Sequence[str] = ()) -> str:
    """Name of a line of the results table: map and strategy, and the method if there are several."""
    method, strategy, variant = key
    name = f"{variant} map, {strategy}"
    return f"{name}, with {method}" if len(methods) > 1 else name


def format_gain(comparison: Comparison) -> str:
    """What a reduced map saves, and what accuracy that costs."""
    return (
        f"{format_ratio(comparison.smaller, 'smaller', 'larger')}, "
        f"{format_ratio(comparison.faster, 'faster', 'slower')}; "
        f"ADD-0.1d {comparison.add_before:.1f} % → {comparison.add_after:.1f} %"
    )


def format_difference(comparison: Comparison) -> str:
    """95 % interval of the change in accuracy, and the probability that the change is chance."""
    low, high = (
        f"{value:+.1f}".replace("-", "\N{MINUS SIGN}")
        for value in (comparison.add_gain.low, comparison.add_gain.high)
    )
    return f"difference {low} to {high} points, p {format_p_value(comparison.p_value)}"


def format_ratio(value: float, more: str, less: str) -> str:
    """A ratio with two digits: `more` is the word for values above 1, `less` for values below."""
    if value < 1:
        value, more = 1 / value, less
    rounded = f"{value:.0f}" if value >= 10 else f"{value:.1f}"
    return f"equally {_STEMS[more]}" if rounded == _EQUAL else f"{rounded}\N{MULTIPLICATION SIGN} {more}"


def format_dominating_set(mapped: MappedObject) -> str:
    """One sentence about an object's dominating set and the proven lower bound on its size."""
    count = len(mapped.dominating_set)
    proof = "no smaller set can" if mapped.lower_bound >= count else f"at least {mapped.lower_bound} must"
    verb = "dominates" if count == 1 else "dominate"
    return (
        f"{format_number(count)} of {format_count(mapped.references, 'image')} {verb} the others ({proof}) "
        f"and {'sees' if count == 1 else 'see'} {format_number(mapped.dominating_points)} of "
        f"{format_count(mapped.points, 'point')}."
    )


def format_error(error: float) -> str:
    """A relative pose error, or "not localized" if it is infinite."""
    return (
        f"{100 * error:.1f}\N{NO-BREAK SPACE}% of\N{NO-BREAK SPACE}d" if isfinite(error) else "not localized"
    )


@dataclass(frozen=True)
class ColumnHead:
    """Header of a table column."""

    title: str
    """Text of the header."""

    meaning: str
    """Explanation, shown as a tooltip."""

    is_number: bool = True
    """Sort the column by value instead of by text."""


@dataclass(frozen=True)
class NumberCell:
    """A number in a table."""

    text: str
    """The formatted number."""

    value: float | int | None
    """Sort key; None, which sorts last, if there is no number."""

    aside: str = ""
    """Small print below the number."""


NO_VALUE = NumberCell("\N{EN DASH}", None)
"""Cell without a value."""


def table_html(
    heads: Sequence[ColumnHead], lines: Sequence[Sequence[str | NumberCell]], marked: Sequence[int] = ()
) -> str:
    """A table that sorts by a click on a header; long tables get a text filter.

    Args:
        heads: Header of each column.
        lines: Cells of each row: numbers, or HTML.
        marked: Indices of highlighted rows.
    """
    head = "".join(
        f'<th scope="col"{_class(one.is_number)} title="{escape(one.meaning)}">'
        f"<button>{escape(one.title)}</button></th>"
        for one in heads
    )
    body = "\n".join(
        f"<tr{_MARKED * (i in marked)}>{''.join(_cell(one) for one in line)}</tr>"
        for i, line in enumerate(lines)
    )
    table = f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>'
    if len(lines) <= _FILTER_ROWS:
        return table
    return (
        '<div><input class="filter" type="search" aria-label="Show rows with these words" '
        f'placeholder="Show rows with: direct default">{table}</div>'
    )


def _class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""


def _cell(cell: str | NumberCell) -> str:
    if isinstance(cell, str):
        return f"<td>{cell}</td>"
    value = "" if cell.value is None else f' data-value="{cell.value:.9g}"'
    aside = f"<small>{escape(cell.aside)}</small>" if cell.aside else ""
    return f'<td class="number"{value}>{escape(cell.text)}{aside}</td>'


_LABELS = {
    "object": ColumnHead("Object", "object, or kind of average", is_number=False),
    "method": ColumnHead("Method", "local features and matcher", is_number=False),
    "strategy": ColumnHead("Strategy", "how queries are matched", is_number=False),
    "variant": ColumnHead("Map", "variant of the map", is_number=False),
}


def rows_html(rows: Sequence[Row], marked: Sequence[MeasurementKey] = ()) -> str:
    """The results table with 95 % intervals in small print.

    Args:
        rows: Rows of one object, or of averages.
        marked: Highlighted lines.
    """
    shown = all_columns(metric=is_metric(rows))
    varies = {name for name in ("object", "method") if len({getattr(row, name) for row in rows}) > 1}
    labels = [name for name in _LABELS if name in varies or name in ("strategy", "variant")]
    lines = [
        [
            *(escape(getattr(row, name)) for name in labels),
            *(_number_cell(row.to_json(), one) for one in shown),
        ]
        for row in rows
    ]
    heads = [*(_LABELS[name] for name in labels), *(ColumnHead(one.title, one.meaning) for one in shown)]
    highlighted = [i for i, row in enumerate(rows) if (row.method, row.strategy, row.variant) in marked]
    return table_html(heads, lines, highlighted)


def _number_cell(values: dict, column: Column) -> NumberCell:
    value = values.get(column.key)
    if value is None:
        return NO_VALUE
    low, high = values.get(f"{column.key}_low"), values.get(f"{column.key}_high")
    aside = "" if low is None or high is None else f"{_short(low)}\N{EN DASH}{_short(high)}"
    return NumberCell(column.show(value), value, aside)


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}"
