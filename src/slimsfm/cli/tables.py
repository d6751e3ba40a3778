"""What commands print in tables: choices of `reduce` and `frontier`, results of `benchmark`."""

from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path

import numpy as np
from rich.table import Table

from slimsfm.cli.arguments import Execution, resumable
from slimsfm.cli.output import console, counts, plural, size
from slimsfm.errors import InputError
from slimsfm.evaluation.comparison import Comparison, DominationSummary
from slimsfm.evaluation.formats import format_p_value, format_value, map_warnings, row_labels
from slimsfm.evaluation.result_files import RunSummary
from slimsfm.evaluation.results import ObjectResult
from slimsfm.evaluation.table import BY_FRAME, Row, brief_columns, is_metric
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.graph import GraphOptions, ReferenceGraph, load_or_compute_graph
from slimsfm.localization import Seconds
from slimsfm.mapping.io import bytes_by_part, read_map
from slimsfm.mapping.map import Map
from slimsfm.progress import shown
from slimsfm.reduction import (
    Candidate,
    Frontier,
    GraphProvider,
    Prediction,
    Reduced,
    ReduceOptions,
    measure_speed,
)
from slimsfm.reduction.disturbance import ROUGH
from slimsfm.reduction.pareto import check_reducible
from slimsfm.report.formatting import format_ratio


def read_reducible(path: Path) -> Map:
    """Read a map that is to be reduced.

    Raises:
        InputError: The map has no features or fewer than two images.
    """
    full = read_map(path)
    try:
        check_reducible(full)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return full


def kept_graph(path: Path, execution: Execution) -> GraphProvider:
    """Read or compute the reference graph of the map at a path, and keep it there."""

    def find(map: Map, options: GraphOptions) -> ReferenceGraph:
        with resumable():
            return load_or_compute_graph(map, path, options, execution.open_executor(), shown).graph

    return find


def print_dominating_set(reduced: Reduced, options: ReduceOptions) -> None:
    """Print the size of a requested dominating set, and whether it is the smallest."""
    graph, solution = reduced.graph, reduced.solution
    if graph is None or solution is None:
        return
    edges = graph.num_edges(options.image_choice.set_options().threshold)
    proof = "proven smallest" if solution.is_cheapest else f"at least {solution.lower_bound} are needed"
    unmet = f"; localized by too few: {plural(solution.unmet, 'image')}" if solution.unmet else ""
    console.print(
        f"reference graph: {plural(edges, 'edge')} among {plural(len(graph.names), 'image')}; "
        f"dominating set: {plural(len(solution.chosen), 'image')} ({proof}){unmet}"
    )


def print_change(full_path: Path, full: Map, slim_path: Path, slim: Map) -> None:
    """Print a table of the contents of a map before and after its reduction."""
    before = {**counts(full), "bytes": bytes_by_part(full_path)["total"]}
    after = {**counts(slim), "bytes": bytes_by_part(slim_path)["total"]}
    table = Table(box=None, header_style="bold", pad_edge=False)
    for column in ("", "before", "after", "factor"):
        table.add_column(column, justify="right" if column else "left")
    for name in before:
        shown_as = size if name == "bytes" else str
        factor = f"{before[name] / after[name]:.1f}" if after[name] else ""
        table.add_row(name, shown_as(before[name]), shown_as(after[name]), factor)
    console.print(table)


def promise(full_path: Path, full: Map, candidate: Candidate) -> str:
    """Say in one sentence what is kept and how it is predicted to localize."""
    choice, tests = candidate.choice, len(candidate.prediction.tests)
    before = f"{plural(len(full.images), 'image')}, {plural(len(full.point3D_ids), 'point')}, "
    before += size(bytes_by_part(full_path)["total"])
    images = f"{plural(len(choice.images), 'image')}, " if choice.images else ""
    after = f"{images}{plural(len(choice.points), 'point')}, {size(candidate.bytes)}"
    if not tests:
        return f"{before} -> {after}; no image is left out to predict by"
    shares = [_share(candidate.prediction.within(ADD_FRACTIONS[0]), candidate.full.within(ADD_FRACTIONS[0]))]
    rough = (one.rough_within(ADD_FRACTIONS[0]) for one in (candidate.prediction, candidate.full))
    for disturbance, slim, best in zip(ROUGH, *rough, strict=False):
        shares.append(f"{_share(slim, best)} after {disturbance.name}")
    return (
        f"{before} -> {after}; predicted to localize {', '.join(shares)} of what the full map does, "
        f"{_errors(full, candidate)} (measured on {plural(tests, 'image')} left out)"
    )


def _errors(full: Map, candidate: Candidate) -> str:
    """Say how large the corner errors are, and how many times as large as with the full map."""
    prediction, growth = candidate.prediction, candidate.growth
    median, p90 = (_length(one, full) for one in (prediction.median_error, prediction.p90_error))
    return (
        f"with a median corner error of {median} and a 90th percentile of {p90}, {growth.median:.2g} and "
        f"{growth.p90:.2g} times the full map's"
    )


def _length(error: float, map: Map) -> str:
    """A relative corner error, and in centimeters where the unit is known."""
    if np.isinf(error):
        return "infinity"
    in_cm = f" ({1e2 * error * map.box.diagonal:.2g} cm)" if map.info.unit == "metre" else ""
    return f"{error:.2g}d{in_cm}"


def _share(part: float, whole: float) -> str:
    return f"{min(100 * part / whole, 100) if whole else 0:.3g} %"


def print_speed(full: Map, slim: Map, use: str = "") -> None:
    """Measure and print how much faster queries are with a reduced map than with the full one."""
    speed = measure_speed(full, slim) if full.has_keypoints else None
    if speed is None:
        return
    ways = [(speed.exhaustive, "exhaustive")]
    if speed.strategy != "exhaustive":
        ways.append((speed.default, f"{speed.strategy}, the default of localize,"))
    whole = isfinite(speed.slim.extract)
    compared = ", ".join(_faster(speed.slim, seconds, way, whole=whole) for seconds, way in ways)
    ours = speed.slim.total if whole else _matching(speed.slim)
    what = f"a whole query{use}, from pixels to pose" if whole else f"matching and pose{use}"
    stages = (
        f" (extract {_ms(speed.slim.extract)}, match and pose {_ms(_matching(speed.slim))})" if whole else ""
    )
    console.print(
        f"{what}: {_ms(ours)} ms{stages}, {compared}; medians of {plural(speed.tests, 'image')} left out"
        + ("" if whole else ", without extraction of features, whose extractor is not available")
    )


def _faster(slim: Seconds, full: Seconds, way: str, *, whole: bool) -> str:
    """How much faster a query is, as a whole if extraction is known, and in matching and pose alone."""
    alone = format_ratio(_matching(full) / _matching(slim), "faster", "slower")
    seconds, ratio, note = _matching(full), alone, ""
    if whole:
        seconds, note = full.total, f"; match and pose alone {alone}"
        ratio = format_ratio(full.total / slim.total, "faster", "slower")
    than = "as" if ratio.startswith("equally") else "than"
    return f"{ratio} {than} {way} on the full map ({_ms(seconds)} ms{note})"


def _matching(seconds: Seconds) -> float:
    return seconds.match + seconds.pose


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}"


def print_frontier(frontier: Frontier, recommended: Mapping[str, Candidate], full_bytes: int) -> None:
    """Print the table of all candidates: Pareto-dominated ones dim, recommended ones bold."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for column in ("for", "method", "asked for"):
        table.add_column(column)
    for column in ("images", "points", "size", *(f"{fraction}d" for fraction in ADD_FRACTIONS)):
        table.add_column(column, justify="right")
    for column in ("loss", "rough loss", "median", "p90", "growth", "match+pose", "query", ""):
        table.add_column(column, justify="right" if column else "left")
    full = _figures(frontier.full, 0.0, 0.0 if frontier.full.rough_errors.size else None, "")
    table.add_row("", "full map", "exhaustive", "", "", size(full_bytes), *full)
    for one in sorted(frontier.candidates, key=lambda one: (one.choice.use, one.choice.method, one.bytes)):
        remark, style = _remark(frontier, recommended, one)
        choice = one.choice
        what = (choice.use, choice.method, choice.detail, str(len(choice.images) or ""))
        weight = (str(len(choice.points)), size(one.bytes))
        table.add_row(
            *what,
            *weight,
            *_figures(one.prediction, one.loss, one.rough_loss, _growth(one)),
            remark,
            style=style,
        )
    console.print(table)
    console.print(
        f"0.1d, 0.05d, 0.02d: % of {len(frontier.full.tests)} images or fewer, left out and given fewer "
        "matches, whose mean corner error is below this share of the diagonal d; loss: percentage points "
        "lost against the full map on the same images, the largest of the three; rough loss: within 0.1d, "
        f"the largest of {' and '.join(one.name for one in ROUGH)}; median, p90: median and 90th "
        "percentile of the corner error; growth: factors of both against the full map, where errors below "
        f"{frontier.full.finest_error:.2g}d, half a pixel, count as this; match+pose: ms, median per "
        "query; query: ms from pixels to pose, with extraction; "
        "Pareto-dominated: another choice for the same use is not larger and loses no more",
        style="dim",
    )


def _growth(one: Candidate) -> str:
    return f"{one.growth.median:.2f} {one.growth.p90:.2f}" if one.prediction.tests else ""


def _figures(prediction: Prediction, loss: float, rough_loss: float | None, growth: str) -> list[str]:
    shares = [f"{prediction.within(fraction):.1f}" for fraction in ADD_FRACTIONS]
    losses = [f"{loss:.1f}", "" if rough_loss is None else f"{rough_loss:.1f}"]
    errors = [f"{error:.4f}d" for error in (prediction.median_error, prediction.p90_error)]
    seconds = prediction.seconds
    whole = f"{1e3 * seconds.total:.1f}" if np.isfinite(seconds.total) else ""
    return [*shares, *losses, *errors, growth, f"{1e3 * _matching(seconds):.2f}", whole]


def _remark(
    frontier: Frontier, recommended: Mapping[str, Candidate], one: Candidate
) -> tuple[str, str | None]:
    if any(best is one for best in recommended.values()):
        return "recommended", "bold"
    return ("Pareto-dominated", "dim") if frontier.is_pareto_dominated(one) else ("", None)


def frontier_to_json(
    frontier: Frontier, recommended: Mapping[str, Candidate], full: Map, full_bytes: int
) -> dict:
    """All candidates as JSON values; a missing value is None."""
    counted = {"images": len(full.images), "points": len(full.point3D_ids), "bytes": full_bytes}
    return {
        "full": counted | _prediction_to_json(frontier.full),
        "candidates": [
            {
                "for": one.choice.use,
                "method": one.choice.method,
                "asked_for": one.choice.detail,
                "images": list(one.choice.images),
                "points": len(one.choice.points),
                "bytes": one.bytes,
                "loss": one.loss,
                "rough_loss": one.rough_loss,
                "median_factor": _finite(one.growth.median),
                "p90_factor": _finite(one.growth.p90),
                "dominated": frontier.is_pareto_dominated(one),
                "recommended": any(best is one for best in recommended.values()),
                **_prediction_to_json(one.prediction),
            }
            for one in frontier.candidates
        ],
    }


def _prediction_to_json(prediction: Prediction) -> dict:
    return {
        "tests": len(prediction.tests),
        **{f"add_{fraction}d": prediction.within(fraction) for fraction in ADD_FRACTIONS},
        "rough_add_0.1d": {
            one.name: share
            for one, share in zip(ROUGH, prediction.rough_within(ADD_FRACTIONS[0]), strict=False)
        },
        "median_corner_error": _finite(prediction.median_error),
        "p90_corner_error": _finite(prediction.p90_error),
        "finest_corner_error": prediction.finest_error,
        "ms": _finite(1e3 * prediction.seconds.total),
        "ms_extract": _finite(1e3 * prediction.seconds.extract),
        "ms_match": 1e3 * prediction.seconds.match,
        "ms_pose": 1e3 * prediction.seconds.pose,
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def print_summary(summary: RunSummary) -> None:
    """Print the table of a run, the comparison of reduced maps with full ones, and the dominating sets."""
    print_rows(summary.rows)
    averages = [one for one in summary.comparisons if one.object == BY_FRAME]
    print_comparisons(averages or summary.comparisons)
    for one in summary.dominating_sets:
        console.print(_dominating_sets(one))


def print_support(results: Sequence[ObjectResult]) -> None:
    """Print one line per map on what supports it, and what contradicts it."""
    for result in results:
        for mapped in result.maps:
            if mapped.quality:
                console.print(f"{result.name}, {mapped.method}: {mapped.quality.summary}")
    print_map_warnings(results)


def print_map_warnings(results: Sequence[ObjectResult]) -> None:
    """Print why the maps that results were measured with are in doubt."""
    for name, method, why in map_warnings(results):
        console.print(f"warning: {name}, {method}: {why}", style="bold red")


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
            f"matching and pose ({one.faster_between.low:.1f} to {one.faster_between.high:.1f}), "
            f"{format_ratio(one.faster_whole, 'faster', 'slower')} with extraction, {smaller}; "
            f"ADD-0.1d {one.add_before:.1f} -> {one.add_after:.1f} "
            f"({one.add_gain.low:+.1f} to {one.add_gain.high:+.1f}, p {format_p_value(one.p_value)})"
        )
