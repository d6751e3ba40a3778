"""The top of the page: what was kept, what that costs, and where it fails, over all objects."""

from collections.abc import Mapping, Sequence
from html import escape

from slimsfm.evaluation.comparison import Comparison, summarize_domination
from slimsfm.evaluation.formats import format_p_value
from slimsfm.evaluation.results import ObjectResult
from slimsfm.evaluation.table import BY_FRAME, BY_OBJECT, Row
from slimsfm.report.drawn_charts import average_charts
from slimsfm.report.failures import failures_html
from slimsfm.report.formatting import difference, format_bytes, format_number, gain, line_name, plural, ratio
from slimsfm.report.report_data import Story
from slimsfm.report.table import NOTHING, Head, Value, rows_html, table_html


def overview_html(story: Story, anchors: Mapping[str, str]) -> str:
    """The sections before those of the objects.

    Args:
        story: What is computed of the run.
        anchors: What a link to an object names, by object.
    """
    lines = story.headlines(story.overall)
    return "\n".join(
        [
            f'<p class="headline">{escape(_headline(story, lines))}</p>',
            _failed(story),
            _tiles(story, lines[0]) if lines else "",
            _objects(story, anchors),
            failures_html(story) if lines else "",
            _averages(story, lines),
        ]
    )


def _headline(story: Story, lines: Sequence[Comparison]) -> str:
    objects = story.run.objects
    queries = sum(len(one.queries) for one in objects)
    of_what = f"{plural(len(objects), 'object')}, {plural(queries, 'query')}"
    if not lines:
        return f"{of_what}: just the full map was measured, so there is nothing to compare."
    first, *others = lines
    told = f"{of_what}: the {line_name(first.after, story.methods)}, is {gain(first)}."
    return told + "".join(f" The {line_name(one.after, story.methods)}: {gain(one)}." for one in others)


def _failed(story: Story) -> str:
    if not story.run.failed:
        return ""
    items = "".join(
        f"<li><b>{escape(name)}</b>: {escape(why)}</li>" for name, why in story.run.failed.items()
    )
    count = plural(len(story.run.failed), "object")
    return f'<section class="card failed"><h2>{count} could not be measured</h2><ul>{items}</ul></section>'


def _tiles(story: Story, line: Comparison) -> str:
    before, after = (story.row(story.overall, key) for key in (line.before, line.after))
    interval = after.intervals["add_0.1d"]
    mean = " on average" * (len(story.run.objects) > 1)
    tiles = [
        (
            "Size of the map",
            f"{format_bytes(before.map_bytes)} → {format_bytes(after.map_bytes)}",
            _smaller(line) + mean,
        ),
        (
            "Matching and pose",
            f"{_milliseconds(before)} → {_milliseconds(after)} ms",
            f"{ratio(line.faster, 'faster', 'slower')} ({_between(line)}), a query",
        ),
        (
            "Accuracy, ADD-0.1d",
            f"{line.add_before:.1f} → {line.add_after:.1f} %",
            f"95 % interval {interval.low:.1f} to {interval.high:.1f}; {difference(line)}",
        ),
        ("Dominating set", *_dominating(story, line)),
    ]
    shown = "".join(
        f'<div class="tile"><h2>{title}</h2><b>{value}</b><p>{escape(told)}</p></div>'
        for title, value, told in tiles
    )
    return (
        f'<div class="tiles">{shown}</div>\n<p class="note">{line_name(line.before).capitalize()} → '
        f"{line_name(line.after)}{_of_method(story, line)}. {_VARIANTS}</p>"
    )


def _of_method(story: Story, line: Comparison) -> str:
    return f", {escape(line.after[0])}" if len(story.methods) > 1 else ""


def _smaller(line: Comparison) -> str:
    return ratio(line.smaller, "smaller", "larger")


def _between(line: Comparison) -> str:
    return f"{line.faster_between.low:.1f} to {line.faster_between.high:.1f}"


def _milliseconds(row: Row) -> str:
    value = 1e3 * (row.scores.seconds.match + row.scores.seconds.pose)
    return f"{value:.1f}" if value < 10 else f"{value:,.0f}"


def _dominating(story: Story, line: Comparison) -> tuple[str, str]:
    summary = next(one for one in summarize_domination(story.run.objects) if one.method == line.after[0])
    counts = f"{summary.mean:.1f} images on average, {summary.smallest} to {summary.largest}"
    if summary.objects == 1:
        counts = plural(summary.largest, "image")
    return (
        f"{100 * summary.images_kept_mean:.0f} % of images",
        f"{counts}; they see {100 * summary.points_kept_mean:.0f} % of the points",
    )


_VARIANTS = """Dominating: images such that every other one is localized by one of them. Default: the points
that <code>slimsfm reduce</code> keeps, to be matched directly."""

_OBJECT_HEADS = (
    Head("Object", "which object", is_number=False),
    Head("Images", "reference images of the full map"),
    Head("Dominating", "images of the dominating set"),
    Head("Size before", "of the full map on disk"),
    Head("Size after", "of the slim map on disk"),
    Head("ADD-0.1d before", "% of queries, with the full map"),
    Head("ADD-0.1d after", "% of queries, with the slim map"),
    Head("p", "probability of such a difference between equally good maps"),
    Head("Times faster", "matching and pose, the full map's time over the slim map's"),
)


def _objects(story: Story, anchors: Mapping[str, str]) -> str:
    if len(story.run.objects) < 2:
        return ""
    lines = [_object_line(story, one, anchors[one.name]) for one in story.run.objects]
    return f'<section class="card"><h2>Objects</h2>\n{table_html(_OBJECT_HEADS, lines)}</section>'


def _object_line(story: Story, result: ObjectResult, anchor: str) -> list[str | Value]:
    found = story.headlines(result.name)
    mapped = result.maps[0]
    counts = (mapped.references, len(mapped.dominating_set))
    start = [
        f'<a href="#{anchor}">{escape(result.name)}</a>',
        *(Value(format_number(one), one) for one in counts),
    ]
    if not found:
        return [*start, *([NOTHING] * (len(_OBJECT_HEADS) - len(start)))]
    line = found[0]
    before, after = (story.row(result.name, key) for key in (line.before, line.after))
    interval = after.intervals["add_0.1d"]
    return [
        *start,
        *(Value(format_bytes(row.map_bytes), row.map_bytes) for row in (before, after)),
        Value(f"{line.add_before:.1f}", line.add_before),
        Value(f"{line.add_after:.1f}", line.add_after, f"{interval.low:.1f}\N{EN DASH}{interval.high:.1f}"),
        Value(format_p_value(line.p_value), line.p_value),
        Value(f"{line.faster:.1f}", line.faster),
    ]


def _averages(story: Story, lines: Sequence[Comparison]) -> str:
    if len(story.run.objects) < 2:
        return ""
    marked = [key for one in lines for key in (one.before, one.after)]
    rows = [*story.rows[BY_FRAME], *story.rows[BY_OBJECT]]
    return f"""<section class="card"><h2>Averages</h2>
{rows_html(rows, marked)}
<p class="note">By frame every query counts alike, by object every object. In small print 95 % intervals over
queries. The headline is about the lines on red ground. A click on a header sorts.</p>
{average_charts(story, lines)}</section>"""
