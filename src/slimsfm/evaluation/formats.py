"""The results of a run as text: Markdown, LaTeX and CSV."""

import csv
import io
from collections.abc import Sequence
from itertools import groupby

from slimsfm.evaluation.comparison import Comparison, DominationSummary, summarize_domination
from slimsfm.evaluation.results import ObjectResult, Run
from slimsfm.evaluation.table import STAGE_COLUMNS, Column, Row, is_metric, paper_columns

_LABELS = ("Object", "Method", "Strategy", "Map")
_NOTHING = "\N{EN DASH}"
_TIMES = "\N{MULTIPLICATION SIGN}"


def row_labels(row: Row) -> tuple[str, str, str, str]:
    """Object, method, strategy and variant of a row."""
    return row.object, row.method, row.strategy, row.variant


def format_value(row: Row, column: Column, *, interval: bool = False) -> str:
    """A value of a row as text, with its 95 % interval on request; a dash if there is no value."""
    values = row.to_json()
    value = values.get(column.key)
    if value is None:
        return _NOTHING
    low, high = values.get(f"{column.key}_low"), values.get(f"{column.key}_high")
    if not interval or low is None or high is None:
        return column.show(value)
    return f"{column.show(value)} [{column.show(low)}, {column.show(high)}]"


def markdown_table(rows: Sequence[Row]) -> str:
    """Markdown table: the paper's columns with 95 % intervals of ADD-0.1d, and the time of each stage."""
    shown_columns = (*paper_columns(metric=is_metric(rows)), *STAGE_COLUMNS)
    header = [*_LABELS, *(column.title for column in shown_columns)]
    rule = [*("---" for _ in _LABELS), *("---:" for _ in shown_columns)]
    lines = [
        [
            *row_labels(row),
            *(format_value(row, column, interval=column.key == "add_0.1d") for column in shown_columns),
        ]
        for row in rows
    ]
    return _markdown(header, rule, *lines)


def markdown_comparisons(comparisons: Sequence[Comparison]) -> str:
    """Markdown table of what rows gain and lose against their baselines."""
    header = [
        "Object",
        "Row",
        "Baseline",
        "ADD-0.1d",
        "95 % interval of the difference",
        "p",
        "faster",
        "smaller",
    ]
    rule = ["---"] * 3 + ["---:"] * 5
    lines = [
        [
            one.object,
            ", ".join(one.after),
            ", ".join(one.before),
            f"{one.add_before:.1f} → {one.add_after:.1f}",
            f"{one.add_gain.low:+.1f} to {one.add_gain.high:+.1f}",
            format_p_value(one.p_value),
            f"{one.faster:.1f}{_TIMES} ({one.faster_between.low:.1f} to {one.faster_between.high:.1f})",
            f"{one.smaller:.1f}{_TIMES}",
        ]
        for one in comparisons
    ]
    return _markdown(header, rule, *lines)


def _markdown(*lines: Sequence[str]) -> str:
    cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)


def format_p_value(value: float) -> str:
    """A probability with three digits; small ones are not rounded to 0."""
    return f"{value:.3f}" if value >= 0.001 else "< 0.001"


def markdown_summaries(summaries: Sequence[DominationSummary]) -> str:
    """Markdown table of the sizes of dominating sets."""
    kept = "Images kept, mean | median | Points kept, mean | median"
    header = f"| Method | Objects | Images, min | mean | max | {kept} |\n|---|{'---:|' * 8}\n"
    lines = [
        f"| {one.method} | {one.objects} | {one.smallest} | {one.mean:.2f} | {one.largest} "
        f"| {one.images_kept_mean:.3f} | {one.images_kept_median:.3f} "
        f"| {one.points_kept_mean:.3f} | {one.points_kept_median:.3f} |\n"
        for one in summaries
    ]
    return header + "".join(lines)


def latex_table(rows: Sequence[Row], caption: str) -> str:
    """The paper's table in LaTeX (booktabs), with rules between objects, methods and strategies."""
    shown_columns = paper_columns(metric=is_metric(rows))
    header = " & ".join(["Method", *(_latex(column.title) for column in shown_columns)])
    groups = [list(group) for _, group in groupby(rows, key=lambda row: row_labels(row)[:3])]
    lines = " \\\\\n    \\midrule\n".join(
        " \\\\\n".join("    " + _latex_line(row, shown_columns) for row in group) for group in groups
    )
    return f"""\\begin{{table*}}
    \\caption{{{_latex(caption)}}}
    \\centering
    \\begin{{tabular}}{{l{"r" * len(shown_columns)}}}
    \\toprule
    {header} \\\\
    \\midrule
{lines} \\\\
    \\bottomrule
    \\end{{tabular}}
\\end{{table*}}
"""


def _latex_line(row: Row, shown_columns: Sequence[Column]) -> str:
    name = f"{row.object}: {row.method}, {row.strategy}"
    cells = [name if row.variant == "full" else f"{name} [{row.variant}]"]
    cells += [format_value(row, column) for column in shown_columns]
    return " & ".join(_latex(cell) for cell in cells)


def _latex(text: str) -> str:
    return text.translate(_LATEX)


_LATEX = str.maketrans(
    {one: f"\\{one}" for one in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\^{}"}
    | {"\N{DEGREE SIGN}": r"$^\circ$", _NOTHING: "--"}
)


def csv_table(rows: Sequence[Row]) -> str:
    """CSV of every value of every row."""
    values = [row.to_json() for row in rows]
    return _csv(list(dict.fromkeys(key for one in values for key in one)), values)


def csv_queries(results: Sequence[ObjectResult]) -> str:
    """CSV of every query of every row, as input for other statistics."""
    values = [
        {
            "object": result.name,
            "method": measurement.method,
            "strategy": measurement.strategy,
            "variant": measurement.variant,
            "draw": draw,
            "query": query.path.name,
            "error": run.outcomes.error[i],
            "rotation_deg": run.outcomes.rotation_deg[i],
            "translation": run.outcomes.translation[i],
            "confidence": run.outcomes.confidence[i],
            "references_tried": run.outcomes.references[i],
            **dict(zip(("s_extract", "s_match", "s_pose"), run.outcomes.seconds[i], strict=True)),
        }
        for result in results
        for measurement in result.measurements
        for draw, run in enumerate(measurement.map_runs)
        for i, query in enumerate(result.queries)
    ]
    return _csv(list(values[0]) if values else [], values)


def _csv(header: list[str], values: list[dict]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, header, lineterminator="\n")
    writer.writeheader()
    writer.writerows(values)
    return text.getvalue()


def map_warnings(results: Sequence[ObjectResult]) -> list[tuple[str, str, str]]:
    """Object, method and sentence for each reason to doubt the maps of objects."""
    return [
        (result.name, mapped.method, warning)
        for result in results
        for mapped in result.maps
        for warning in (mapped.quality.warnings if mapped.quality else ())
    ]


def _markdown_maps(results: Sequence[ObjectResult]) -> str:
    """Lists of what supports the maps of objects, and of reasons to doubt them."""
    support = [
        f"- {result.name}, {mapped.method}: {mapped.quality.summary if mapped.quality else 'not measured'}\n"
        for result in results
        for mapped in result.maps
    ]
    warnings = [f"- **warning**: {name}, {method}: {why}\n" for name, method, why in map_warnings(results)]
    left_out = [
        f"- {result.name}: {len(result.contradicted)} images left out, whose true poses others contradict: "
        f"{'; '.join(result.contradicted.values())}\n"
        for result in results
        if result.contradicted
    ]
    return "".join([*support, *left_out, *warnings])


def markdown_page(run: Run, rows: Sequence[Row], comparisons: Sequence[Comparison]) -> str:
    """A Markdown page with the tables of a run and its environment."""
    made = "\n".join(f"- {key}: {value}" for key, value in run.environment.items())
    failed = "".join(f"\n**{name} failed**: {why}\n" for name, why in run.failed.items())
    return f"""# {run.dataset}
{failed}
{markdown_table(rows)}
Accuracy in % of queries, with 95 % bootstrap intervals over queries; d is the diagonal of the object's box.

## Against the full map

{markdown_comparisons(comparisons)}
p: probability of such a difference between equally good maps, by sign flips of the differences per query.
Faster: matching and pose estimation, without extraction.

## Dominating sets

{markdown_summaries(summarize_domination(run.objects))}
## Support of the full maps

{_markdown_maps(run.objects)}
## Environment

{made}
"""
