"""The top of the page: what was kept, what that costs, and where it fails, over all objects."""

from collections.abc import Mapping, Sequence
from html import escape

from matplotlib.figure import Figure

from slimsfm.evaluation.comparison import Comparison, summarize_domination
from slimsfm.evaluation.formats import format_p_value
from slimsfm.evaluation.results import ObjectResult, join_outcomes
from slimsfm.evaluation.table import BY_FRAME, BY_OBJECT, Row, format_bytes, format_number
from slimsfm.report.failures import failures_html
from slimsfm.report.figures import figure_svg
from slimsfm.report.formatting import (
    NO_VALUE,
    ColumnHead,
    NumberCell,
    format_count,
    format_difference,
    format_gain,
    format_line,
    format_ratio,
    rows_html,
    table_html,
)
from slimsfm.report.map_support import warnings_html
from slimsfm.report.reliability import reliability_chart
from slimsfm.report.report_data import ReportData
from slimsfm.report.tradeoffs import frontier_chart

_CSS_DPI = 96

_ADD = """ADD-0.1d is the share of queries whose box corners are off by less than 0.1 d on average; d is the
diagonal of the object's box."""
_VARIANTS = """Dominating: images such that each other image is localized by one of them. Default: the points
that <code>slimsfm reduce</code> keeps for direct matching."""


def overview_html(data: ReportData, anchors: Mapping[str, str]) -> str:
    """The sections before those of the objects.

    Args:
        data: The run.
        anchors: Link targets of the objects, by name.
    """
    lines = data.headlines(data.overall)
    return "\n".join(
        [
            f'<p class="headline">{escape(_headline(data, lines))}</p>',
            f'<p class="note">{_ADD}</p>',
            _failed(data),
            warnings_html(data.run, anchors),
            _tiles(data, lines[0]) if lines else "",
            _objects(data, anchors),
            failures_html(data) if lines else "",
            _averages(data, lines),
        ]
    )


def _headline(data: ReportData, lines: Sequence[Comparison]) -> str:
    objects = data.run.objects
    queries = sum(len(one.queries) for one in objects)
    counts = f"{format_count(len(objects), 'object')}, {format_count(queries, 'query')}"
    if not lines:
        return f"{counts}: only the full map was measured, so there is nothing to compare."
    first, *others = lines
    said = f"{counts}: the {format_line(first.after, data.methods)}, is {format_gain(first)}."
    return said + "".join(
        f" The {format_line(one.after, data.methods)}: {format_gain(one)}." for one in others
    )


def _failed(data: ReportData) -> str:
    if not data.run.failed:
        return ""
    items = "".join(f"<li><b>{escape(name)}</b>: {escape(why)}</li>" for name, why in data.run.failed.items())
    count = format_count(len(data.run.failed), "object")
    return f'<section class="card failed"><h2>{count} could not be measured</h2><ul>{items}</ul></section>'


def _tiles(data: ReportData, line: Comparison) -> str:
    before, after = (data.row(data.overall, key) for key in (line.before, line.after))
    interval, faster = after.intervals["add_0.1d"], line.faster_between
    mean = " on average" * (len(data.run.objects) > 1)
    tiles = [
        (
            "Size of the map",
            f"{format_bytes(before.map_bytes)} → {format_bytes(after.map_bytes)}",
            format_ratio(line.smaller, "smaller", "larger") + mean,
        ),
        (
            "Whole query, from pixels to pose",
            f"{_milliseconds(before)} → {_milliseconds(after)} ms",
            f"{format_ratio(line.faster_whole, 'faster', 'slower')}; matching and pose alone "
            f"{format_ratio(line.faster, 'faster', 'slower')}, 95 % interval {faster.low:.1f} to "
            f"{faster.high:.1f}",
        ),
        (
            "Accuracy, ADD-0.1d",
            f"{line.add_before:.1f} → {line.add_after:.1f} %",
            f"95 % interval {interval.low:.1f} to {interval.high:.1f}; {format_difference(line)}",
        ),
        ("Dominating set", *_dominating(data, line)),
    ]
    shown = "".join(
        f'<div class="tile"><h2>{title}</h2><b>{value}</b><p>{escape(detail)}</p></div>'
        for title, value, detail in tiles
    )
    method = f", {escape(line.after[0])}" if len(data.methods) > 1 else ""
    return (
        f'<div class="tiles">{shown}</div>\n<p class="note">{format_line(line.before).capitalize()} → '
        f"{format_line(line.after)}{method}. {_VARIANTS}</p>"
    )


def _milliseconds(row: Row) -> str:
    value = 1e3 * row.scores.seconds.total
    return f"{value:.1f}" if value < 10 else f"{value:,.0f}"


def _dominating(data: ReportData, line: Comparison) -> tuple[str, str]:
    summary = next(one for one in summarize_domination(data.run.objects) if one.method == line.after[0])
    if summary.smallest == summary.largest:
        counts = format_count(summary.largest, "image") + " per object" * (summary.objects > 1)
    else:
        counts = f"{summary.mean:.1f} images on average, {summary.smallest} to {summary.largest}"
    return (
        f"{100 * summary.images_kept_mean:.0f} % of images",
        f"{counts}; sees {100 * summary.points_kept_mean:.0f} % of the points",
    )


_OBJECT_HEADS = (
    ColumnHead("Object", "name of the object", is_number=False),
    ColumnHead("Images", "reference images of the full map"),
    ColumnHead("Dominating", "images of the dominating set"),
    ColumnHead("Size before", "size of the full map on disk"),
    ColumnHead("Size after", "size of the reduced map on disk"),
    ColumnHead("ADD-0.1d before", "% of queries, with the full map"),
    ColumnHead("ADD-0.1d after", "% of queries, with the reduced map"),
    ColumnHead("p", "probability of such a difference between equally accurate maps"),
    ColumnHead("Times faster", "time of a whole query with the full map over that with the reduced map"),
    ColumnHead("Matching", "the same for matching and pose alone"),
)


def _objects(data: ReportData, anchors: Mapping[str, str]) -> str:
    if len(data.run.objects) < 2:
        return ""
    lines = [_object_line(data, one, anchors[one.name]) for one in data.run.objects]
    return f'<section class="card"><h2>Objects</h2>\n{table_html(_OBJECT_HEADS, lines)}</section>'


def _object_line(data: ReportData, result: ObjectResult, anchor: str) -> list[str | NumberCell]:
    found = data.headlines(result.name)
    mapped = result.maps[0]
    counts = (mapped.references, len(mapped.dominating_set))
    link = f'<a href="#{anchor}">{escape(result.name)}</a>'
    start = [link, *(NumberCell(format_number(one), one) for one in counts)]
    if not found:
        return [*start, *([NO_VALUE] * (len(_OBJECT_HEADS) - len(start)))]
    line = found[0]
    before, after = (data.row(result.name, key) for key in (line.before, line.after))
    interval = after.intervals["add_0.1d"]
    return [
        *start,
        *(NumberCell(format_bytes(row.map_bytes), row.map_bytes) for row in (before, after)),
        NumberCell(f"{line.add_before:.1f}", line.add_before),
        NumberCell(
            f"{line.add_after:.1f}", line.add_after, f"{interval.low:.1f}\N{EN DASH}{interval.high:.1f}"
        ),
        NumberCell(format_p_value(line.p_value), line.p_value),
        NumberCell(f"{line.faster_whole:.1f}", line.faster_whole),
        NumberCell(f"{line.faster:.1f}", line.faster),
    ]


def _averages(data: ReportData, lines: Sequence[Comparison]) -> str:
    if len(data.run.objects) < 2:
        return ""
    marked = [key for one in lines for key in (one.before, one.after)]
    rows = [*data.rows[BY_FRAME], *data.rows[BY_OBJECT]]
    charts = [frontier_chart(data.rows[BY_FRAME])]
    if lines:
        cells = [cell for one in data.run.objects if (cell := one.measurement(*lines[0].after))]
        charts.append(reliability_chart(join_outcomes([cell.outcomes for cell in cells])))
    return f"""<section class="card"><h2>Averages</h2>
{rows_html(rows, marked)}
<p class="note">By frame: each query has the same weight. By object: each object has. Small print: 95 %
intervals over queries. Lines of the headline have a red background. Click on a header to sort.</p>
{charts_html(charts)}</section>"""


def charts_html(charts: Sequence[Figure]) -> str:
    """Charts next to each other, as wide as they were drawn."""
    drawn = "\n".join(
        f'<div class="chart" style="--width: {_CSS_DPI * one.get_figwidth():.0f}px">{figure_svg(one)}</div>'
        for one in charts
    )
    return f'<div class="charts">\n{drawn}\n</div>'
