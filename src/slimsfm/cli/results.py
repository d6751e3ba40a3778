"""What the commands that measure share: showing a run and writing its results."""

from collections.abc import Sequence

from rich.table import Table

from slimsfm.cli.output import console
from slimsfm.evaluation.columns import brief_columns
from slimsfm.evaluation.comparison import Comparison, against_full
from slimsfm.evaluation.formats import (
    all_rows,
    csv_queries,
    csv_table,
    is_metric,
    labels,
    latex_table,
    markdown_page,
    p_value,
    shown,
)
from slimsfm.evaluation.result_files import run_to_json, write_json
from slimsfm.evaluation.results import Run
from slimsfm.evaluation.summary import summarize_domination
from slimsfm.evaluation.table import BY_FRAME, Row
from slimsfm.files import replacing
from slimsfm.report.formatting import format_ratio


def report_run(run: Run) -> None:
    """Write a run into its folder, and print its table, what slim maps gain and lose, and dominating sets."""
    rows, comparisons = all_rows(run), against_full(run.objects)
    _write(run, rows, comparisons)
    print_rows(rows)
    print_comparisons([one for one in comparisons if one.object == BY_FRAME] or comparisons)
    for one in summarize_domination(run.objects):
        console.print(
            f"{one.method}: dominating sets of {one.smallest} to {one.largest} images, {one.mean:.2f} "
            f"on average; images kept {one.images_kept_mean:.3f} (median {one.images_kept_median:.3f}), "
            f"points kept {one.points_kept_mean:.3f} (median {one.points_kept_median:.3f})"
        )


def _write(run: Run, rows: Sequence[Row], comparisons: Sequence[Comparison]) -> None:
    """results.json, and the table as Markdown, LaTeX and CSV."""
    data = run_to_json(run) | {
        "rows": [row.to_json() for row in rows],
        "comparisons": [one.to_json() for one in comparisons],
        "dominating_sets": [one.to_json() for one in summarize_domination(run.objects)],
    }
    texts = {
        "table.md": markdown_page(run, rows, comparisons),
        "table.tex": latex_table(rows, run.dataset),
        "table.csv": csv_table(rows),
        "queries.csv": csv_queries(run.objects),
    }
    for name, text in texts.items():
        with replacing(run.folder / name, overwrite=True) as partial:
            partial.write_text(text, encoding="utf-8")
    write_json(run.folder / "results.json", data)


def print_rows(rows: Sequence[Row]) -> None:
    """Print the table; the degree-centimetre columns only where the unit is metric."""
    metric = is_metric(rows)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for title in ("object", "method", "strategy", "map"):
        table.add_column(title, no_wrap=True)
    for column in brief_columns(metric=metric):
        table.add_column(column.title.removesuffix(" ms"), justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*labels(row), *(shown(row, one) for one in brief_columns(metric=metric)))
    console.print(table)
    console.print(
        "ADD-0.1d: % of queries with box corners off by less than a tenth of the diagonal d; "
        "extract, match, pose: ms a query; intervals and more are in table.md and table.csv",
        style="dim",
    )
    if not metric:
        console.print("n°-n cm: not given, for the unit of the map is unknown", style="dim")


def print_comparisons(comparisons: Sequence[Comparison]) -> None:
    """Say, line by line, what one map gains and what it costs against another."""
    for one in comparisons:
        faster, smaller = (
            format_ratio(one.faster, "faster", "slower"),
            format_ratio(one.smaller, "smaller", "larger"),
        )
        console.print(
            f"{one.object}, {', '.join(one.after)}: {faster} in matching and pose "
            f"({one.faster_between.low:.1f} to {one.faster_between.high:.1f}) than {', '.join(one.before)}, "
            f"{smaller}; ADD-0.1d {one.add_before:.1f} -> {one.add_after:.1f} "
            f"({one.add_gain.low:+.1f} to {one.add_gain.high:+.1f}, p {p_value(one.p_value)})"
        )
