"""Tables as HTML: a click on a header sorts them, words in a field filter them."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from slimsfm.evaluation.comparison import MeasurementKey
from slimsfm.evaluation.formats import is_metric
from slimsfm.evaluation.table import Column, Row, all_columns

_MARKED = ' class="marked"'
_MANY = 12  # rows, from which on a filter is worth its place


@dataclass(frozen=True)
class Head:
    """The header of a column."""

    title: str
    """What stands there."""

    meaning: str
    """The same at length, shown when pointed at."""

    is_number: bool = True
    """Whether the column is sorted by value, not by text."""


@dataclass(frozen=True)
class Value:
    """A number in a table."""

    text: str
    """As it is written."""

    value: float | int | None
    """What it is sorted by; None, which comes last, where there is no number."""

    aside: str = ""
    """Small print below it."""


NOTHING = Value("\N{EN DASH}", None)
"""Where a table has no value."""

_STRATEGY = Head("Strategy", "how queries are matched", is_number=False)
_VARIANT = Head("Map", "which variant of the map", is_number=False)
_METHOD = Head("Method", "local features, and what matches them", is_number=False)
_OBJECT = Head("Object", "which object, or which average", is_number=False)


def table_html(
    heads: Sequence[Head], lines: Sequence[Sequence[str | Value]], marked: Sequence[int] = ()
) -> str:
    """A table.

    Args:
        heads: The header of each column.
        lines: The cells of each row: numbers, or text that already is HTML.
        marked: Rows that stand out, by index.
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
    if len(lines) <= _MANY:
        return table
    return (
        '<div><input class="filter" type="search" aria-label="Show rows with these words" '
        f'placeholder="Show rows with: direct default">{table}</div>'
    )


def _class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""


def _cell(cell: str | Value) -> str:
    if isinstance(cell, str):
        return f"<td>{cell}</td>"
    value = "" if cell.value is None else f' data-value="{cell.value:.9g}"'
    aside = f"<small>{escape(cell.aside)}</small>" if cell.aside else ""
    return f'<td class="number"{value}>{escape(cell.text)}{aside}</td>'


def rows_html(rows: Sequence[Row], marked: Sequence[MeasurementKey] = ()) -> str:
    """The paper's table, with 95 % intervals in small print; what has no value shows as a dash.

    Args:
        rows: Of one object, or of averages.
        marked: Lines that stand out.
    """
    shown = all_columns(metric=is_metric(rows))
    texts = [(_STRATEGY, lambda row: row.strategy), (_VARIANT, lambda row: row.variant)]
    if len({row.method for row in rows}) > 1:
        texts.insert(0, (_METHOD, lambda row: row.method))
    if len({row.object for row in rows}) > 1:
        texts.insert(0, (_OBJECT, lambda row: row.object))
    lines = [
        [*(escape(text(row)) for _, text in texts), *(_value(row.to_json(), one) for one in shown)]
        for row in rows
    ]
    heads = [*(head for head, _ in texts), *(Head(one.title, one.meaning) for one in shown)]
    stand_out = [i for i, row in enumerate(rows) if (row.method, row.strategy, row.variant) in marked]
    return table_html(heads, lines, stand_out)


def _value(values: dict, column: Column) -> Value:
    value = values.get(column.key)
    if value is None:
        return NOTHING
    low, high = values.get(f"{column.key}_low"), values.get(f"{column.key}_high")
    aside = "" if low is None or high is None else f"{_short(low)}\N{EN DASH}{_short(high)}"
    return Value(column.show(value), value, aside)


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}"
