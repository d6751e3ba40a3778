"""The paper's table: one row a method, strategy and variant of the map, of each object and over all."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from slimsfm.evaluation.metrics import DEG_CM, SURE
from slimsfm.evaluation.outcomes import join
from slimsfm.evaluation.results import Cell, ObjectResult
from slimsfm.evaluation.scores import Scores, mean_scores, score, shares
from slimsfm.evaluation.statistics import Interval, bootstrap
from slimsfm.geometry import ADD_FRACTIONS

BY_FRAME = "all, by frame"
"""The object of rows in which every query counts alike, as in the paper."""

BY_OBJECT = "all, by object"
"""The object of rows in which every object counts alike."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """How one strategy does on one variant of a map."""

    object: str
    """Name of the object or scene, or that of an average."""

    method: str
    """The method: an extractor, or extractor+matcher."""

    strategy: str
    """How queries were matched."""

    variant: str
    """Which map."""

    references: float
    """Reference images of the map; a mean where there are several maps."""

    points: float
    """Points of the map, likewise."""

    map_bytes: float
    """Size of the map on disk, likewise."""

    scores: Scores
    """What localizing the queries gave, likewise."""

    intervals: dict[str, Interval]
    """95 % intervals of the percentages and of the queries a second, by name in `to_json`."""

    def to_json(self) -> dict:
        """The row as plain values, under the names of `results.json`; what has no value is None."""
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
    return [_row(result.name, [cell], metric=result.unit == "metre") for cell in result.cells]


def average_rows(results: Sequence[ObjectResult]) -> list[Row]:
    """The averages over several objects, by frame and by object, each over those that have the line."""
    if len(results) < 2:
        return []
    keys = dict.fromkeys(cell.key for result in results for cell in result.cells)
    metric = all(result.unit == "metre" for result in results)
    cells = {key: [cell for one in results if (cell := one.cell(*key))] for key in keys}
    return [
        _row(name, some, metric=metric, by_object=name == BY_OBJECT)
        for name in (BY_FRAME, BY_OBJECT)
        for some in cells.values()
    ]


def _row(name: str, cells: Sequence[Cell], *, metric: bool, by_object: bool = True) -> Row:
    """One row of the cells that objects have of one key."""
    each = [score(cell.outcomes, metric=metric, trials=len(cell.trials)) for cell in cells]
    sizes = np.array([one.queries for one in each])
    weights = np.ones(len(cells)) / len(cells) if by_object else sizes / sizes.sum()
    maps = np.array(
        [
            np.mean([(trial.references, trial.points, trial.map_bytes) for trial in cell.trials], axis=0)
            for cell in cells
        ]
    )
    references, points, map_bytes = maps.mean(axis=0).tolist()
    return Row(
        object=name,
        method=cells[0].method,
        strategy=cells[0].strategy,
        variant=cells[0].variant,
        references=references,
        points=points,
        map_bytes=map_bytes,
        scores=mean_scores(each) if by_object else _pooled(cells, metric=metric),
        intervals=_intervals(cells, weights, metric=metric),
    )


def _pooled(cells: Sequence[Cell], *, metric: bool) -> Scores:
    """All queries of all objects in one heap."""
    outcomes = join([cell.outcomes for cell in cells])
    return score(outcomes, metric=metric, trials=len(cells[0].trials))


def per_query(cell: Cell, values: np.ndarray) -> Float64[np.ndarray, " queries"]:
    """The mean over the trials of a cell of values of its outcomes."""
    return values.reshape(len(cell.trials), -1).mean(axis=0).astype(np.float64)


def _intervals(cells: Sequence[Cell], weights: np.ndarray, *, metric: bool) -> dict[str, Interval]:
    criteria = shares(metric=metric)

    def values(cell: Cell) -> Float64[np.ndarray, "queries k"]:
        found = [100 * per_query(cell, fulfil(cell.outcomes)) for fulfil in criteria.values()]
        return np.column_stack([*found, per_query(cell, cell.outcomes.seconds.sum(axis=1))])

    def figures(means: Float64[np.ndarray, "resamples groups k"]) -> Float64[np.ndarray, "resamples k"]:
        found = np.einsum("rgk,g->rk", means, weights)
        found[:, -1] = 1 / found[:, -1]
        return found

    intervals = bootstrap([values(cell) for cell in cells], figures)
    return dict(zip([*criteria, "fps"], intervals, strict=True))
