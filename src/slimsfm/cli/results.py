"""Print the tables of a benchmark."""

from collections.abc import Sequence

from rich.table import Table

from slimsfm.cli.output import console
from slimsfm.evaluation.comparison import Comparison, DominationSummary
from slimsfm.evaluation.formats import format_p_value, format_value, row_labels
from slimsfm.evaluation.result_files import RunSummary
from slimsfm.evaluation.table import BY_FRAME, Row, brief_columns, is_metric
from slimsfm.report.formatting import format_ratio, plural


def print_summary(summary: RunSummary) -> None:
    """Print the table of a run, the comparison of reduced maps with full ones, and the dominating sets."""
    print_rows(summary.rows)
    averages = [one for one in summary.comparisons if one.object == BY_FRAME]
    print_comparisons(averages or summary.comparisons)
    for one in summary.dominating_sets:
        console.print(_dominating_sets(one))


def _dominating_sets(one: DominationSummary) -> str:
    if one.smallest == one.largest:
        sizes = f"dominating sets of {plural(one.largest, 'image')}"
    else:
        sizes = f"dominating sets of {one.smallest} to {one.largest} images, {one.mean:.2f} on average"
    return (
        f"{one.method}: {sizes}; images kept {one.images_kept_mean:.3f} (median "
        f"{one.images_kept_median:.3f}), points kept {one.points_kept_mean:.3f} (median "
        f"{one.points_kept_median:.3f})"
    )


def print_rows(rows: Sequence[Row]) -> None:
    """Print the table, with the degree-centimeter columns only if the unit is known."""
    metric = is_metric(rows)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for title in ("object", "method", "strategy", "map"):
        table.add_column(title, no_wrap=True)
    for column in brief_columns(metric=metric):
        table.add_column(column.title.removesuffix(" ms"), justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row_labels(row), *(format_value(row, one) for one in brief_columns(metric=metric)))
    console.print(table)
    console.print(
        "ADD-0.1d: % of queries with a mean box corner error below a tenth of the diagonal d; "
        "extract, match, pose: ms per query; intervals and more are in table.md and table.csv",
        style="dim",
    )
    if not metric:
        console.print("n°-n cm: not available, because the unit of the map is unknown", style="dim")


def print_comparisons(comparisons: Sequence[Comparison]) -> None:
    """Print, row by row, what one map gains and loses against another."""
    for one in comparisons:
        faster, smaller = (
            format_ratio(one.faster, "faster", "slower"),
            format_ratio(one.smaller, "smaller", "larger"),
        )
        console.print(
            f"{one.object}, {', '.join(one.after)} compared with {', '.join(one.before)}: {faster} in "
            f"matching and pose ({one.faster_between.low:.1f} to {one.faster_between.high:.1f}), {smaller}; "
            f"ADD-0.1d {one.add_before:.1f} -> {one.add_after:.1f} "
            f"({one.add_gain.low:+.1f} to {one.add_gain.high:+.1f}, p {format_p_value(one.p_value)})"
        )
