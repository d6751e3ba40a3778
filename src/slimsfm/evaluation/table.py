"""The paper's table: one row per method, strategy and variant of the map, per object and over all objects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from slimsfm.evaluation.results import Measurement, ObjectResult, Run, join_outcomes
from slimsfm.evaluation.scores import (
    DEG_CM,
    SURE,
    Interval,
    Scores,
    bootstrap,
    criteria,
    mean_scores,
    score,
)
from slimsfm.geometry import ADD_FRACTIONS

BY_FRAME = "all, by frame"
"""Object name of rows in which all queries have equal weights, as in the paper."""

BY_OBJECT = "all, by object"
"""Object name of rows in which all objects have equal weights."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Results of one method and strategy on one variant of the map."""

    object: str
    """Name of the object or scene, `BY_FRAME` or `BY_OBJECT`."""

    method: str
    """Name of the method: EXTRACTOR or EXTRACTOR+MATCHER."""

    strategy: str
    """How queries are matched."""

    variant: str
    """Variant of the map."""

    references: float
    """Number of reference images in the map; the mean over several maps."""

    points: float
    """Number of points in the map; the mean over several maps."""

    map_bytes: float
    """Size of the map on disk; the mean over several maps."""

    scores: Scores
    """Scores of the queries; pooled or averaged over several maps."""

    intervals: dict[str, Interval]
    """95 % intervals of the percentages and of the queries per second, by their names in `to_json`."""

    def to_json(self) -> dict:
        """Plain values by their names in `results.json`; a missing value is None."""
        scores, seconds = self.scores, self.scores.seconds
        values = {
            "object": self.object,
            "method": self.method,
            "strategy": self.strategy,
            "variant": self.variant,
            "references": self.references,
            "points": self.points,
            "map_bytes": self.map_bytes,
            "queries": scores.queries,
            "localized": scores.localized,
            **{f"add_{fraction}d": scores.add[fraction] for fraction in ADD_FRACTIONS},
            "median_error": scores.median_error if np.isfinite(scores.median_error) else None,
            f"confidence_wrong_at_{SURE}": scores.confidence_wrong,
            "references_tried": scores.references_tried,
            "ms_extract": 1e3 * seconds.extract,
            "ms_match": 1e3 * seconds.match,
            "ms_pose": 1e3 * seconds.pose,
            "ms_total": 1e3 * seconds.total,
            "fps": scores.fps,
        }
        if scores.deg_cm is not None:
            values |= {f"{n}deg_{n}cm": scores.deg_cm[n] for n in DEG_CM}
        for key, interval in self.intervals.items():
            values |= {f"{key}_low": interval.low, f"{key}_high": interval.high}
        return values


def rows_of(result: ObjectResult) -> list[Row]:
    """The rows of an object."""
    return [_row(result.name, [one], metric=result.unit == "metre") for one in result.measurements]


def average_rows(results: Sequence[ObjectResult]) -> list[Row]:
    """Averages over several objects, by frame and by object, each over the objects that have the row."""
    if len(results) < 2:
        return []
    keys = dict.fromkeys(one.key for result in results for one in result.measurements)
    metric = all(result.unit == "metre" for result in results)
    found = {key: [found for one in results if (found := one.measurement(*key))] for key in keys}
    return [
        _row(name, some, metric=metric, by_object=name == BY_OBJECT)
        for name in (BY_FRAME, BY_OBJECT)
        for some in found.values()
    ]


def all_rows(run: Run) -> list[Row]:
    """The averages, then the rows of every object."""
    return [*average_rows(run.objects), *(row for one in run.objects for row in rows_of(one))]


def is_metric(rows: Sequence[Row]) -> bool:
    """Whether any row has values in centimeters."""
    return any(row.scores.deg_cm is not None for row in rows)


def _row(name: str, some: Sequence[Measurement], *, metric: bool, by_object: bool = True) -> Row:
    """One row from the measurements of several objects with the same key."""
    each = [score(one.outcomes, metric=metric, draws=len(one.map_runs)) for one in some]
    sizes = np.array([one.queries for one in each])
    weights = np.ones(len(some)) / len(some) if by_object else sizes / sizes.sum()
    maps = np.array(
        [
            np.mean([(run.references, run.points, run.map_bytes) for run in one.map_runs], axis=0)
            for one in some
        ]
    )
    references, points, map_bytes = maps.mean(axis=0).tolist()
    return Row(
        object=name,
        method=some[0].method,
        strategy=some[0].strategy,
        variant=some[0].variant,
        references=references,
        points=points,
        map_bytes=map_bytes,
        scores=mean_scores(each) if by_object else _pooled(some, metric=metric),
        intervals=_intervals(some, weights, metric=metric),
    )


def _pooled(some: Sequence[Measurement], *, metric: bool) -> Scores:
    """Scores of the queries of all objects together."""
    outcomes = join_outcomes([one.outcomes for one in some])
    return score(outcomes, metric=metric, draws=len(some[0].map_runs))


def mean_over_draws(measurement: Measurement, values: np.ndarray) -> Float64[np.ndarray, " queries"]:
    """Mean over the map runs, per query, of values that belong to the outcomes."""
    return values.reshape(len(measurement.map_runs), -1).mean(axis=0).astype(np.float64)


def _intervals(some: Sequence[Measurement], weights: np.ndarray, *, metric: bool) -> dict[str, Interval]:
    conditions = criteria(metric=metric)

    def values(one: Measurement) -> Float64[np.ndarray, "queries k"]:
        found = [100 * mean_over_draws(one, meets(one.outcomes)) for meets in conditions.values()]
        return np.column_stack([*found, mean_over_draws(one, one.outcomes.seconds.sum(axis=1))])

    def figures(means: Float64[np.ndarray, "resamples groups k"]) -> Float64[np.ndarray, "resamples k"]:
        found = np.einsum("rgk,g->rk", means, weights)
        found[:, -1] = 1 / found[:, -1]
        return found

    intervals = bootstrap([values(one) for one in some], figures)
    return dict(zip([*conditions, "fps"], intervals, strict=True))


@dataclass(frozen=True)
class Column:
    """A column of the table."""

    title: str
    """Header."""

    meaning: str
    """Explanation of the header."""

    key: str
    """Name of the value in `Row.to_json`."""

    show: Callable[[float], str]
    """Formats a value."""


def format_number(value: float | int) -> str:
    """A count, or a mean of counts, with thousands separators."""
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:,.1f}"


def format_bytes(num_bytes: float | int) -> str:
    """A size in B, kB, MB or GB; 1 kB is 1000 bytes."""
    value, units = float(num_bytes), ["B", "kB", "MB", "GB"]
    while value >= 999.5 and len(units) > 1:
        value, units = value / 1000, units[1:]
    return f"{value:.1f} {units[0]}" if value < 10 and units[0] != "B" else f"{value:.0f} {units[0]}"


def _decimal(value: float | int) -> str:
    return f"{value:.1f}"


def _percent(value: float | int) -> str:
    return f"{100 * value:.1f}"


def _percent_of_d(value: float | int) -> str:
    return f"{100 * value:.2f} %"


MAP_COLUMNS = (
    Column("Images", "reference images of the map", "references", format_number),
    Column("Points", "3D points of the map", "points", format_number),
    Column("Map size", "size of the map on disk", "map_bytes", format_bytes),
)

_METRIC = tuple(
    Column(f"{n}°-{n}cm", f"% of queries within {n}° and {n} cm", f"{n}deg_{n}cm", _decimal) for n in DEG_CM
)

_ADD = tuple(
    Column(
        f"ADD-{fraction}d",
        f"% of queries with a mean box corner error below {fraction} of the diagonal d",
        f"add_{fraction}d",
        _decimal,
    )
    for fraction in ADD_FRACTIONS
)

_ERROR = (Column("Median error", "median error, in % of d", "median_error", _percent_of_d),)

_TRUST = (
    Column(
        "Wrong when sure",
        "% of poses off by more than 0.1 of the diagonal, among those with confidence above 0.9",
        f"confidence_wrong_at_{SURE}",
        _percent,
    ),
    Column("Tried", "mean number of reference images matched per query", "references_tried", _decimal),
)

STAGE_COLUMNS = (
    Column("Extract ms", "milliseconds per query: feature extraction", "ms_extract", _decimal),
    Column("Match ms", "milliseconds per query: matching", "ms_match", _decimal),
    Column("Pose ms", "milliseconds per query: pose estimation", "ms_pose", _decimal),
)

_FPS = (Column("FPS", "queries per second, all stages together", "fps", _decimal),)


def all_columns(*, metric: bool) -> tuple[Column, ...]:
    """All columns; those in centimeters only if the unit is known."""
    return (*MAP_COLUMNS, *(_METRIC if metric else ()), *_ADD, *_ERROR, *_TRUST, *STAGE_COLUMNS, *_FPS)


def paper_columns(*, metric: bool) -> tuple[Column, ...]:
    """The columns of the paper's table, after the size of the map."""
    return (*MAP_COLUMNS, *(_METRIC if metric else ()), _ADD[0], *_FPS)


def brief_columns(*, metric: bool) -> tuple[Column, ...]:
    """Columns that fit into a terminal: the paper's, stricter accuracy, and the time of each stage."""
    return (*MAP_COLUMNS, *(_METRIC if metric else ()), *_ADD, *STAGE_COLUMNS, *_FPS)
