"""Two lines of the table on the same queries: what one gains, and whether that is chance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from slimsfm.errors import InputError
from slimsfm.evaluation.results import Cell, ObjectResult, Run
from slimsfm.evaluation.statistics import Interval, bootstrap, paired_p_value
from slimsfm.evaluation.table import BY_FRAME, per_query
from slimsfm.geometry import ADD_FRACTIONS

Key = tuple[str, str, str]
"""Method, strategy and variant."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """How one line of the table stands against another, query by query."""

    object: str
    """Name of the object, or that of the average by frame."""

    before: Key
    """The line that is compared with."""

    after: Key
    """The line that is compared."""

    queries: int
    """How many both localized, or tried to."""

    add_before: float
    """ADD-0.1d of the one in percent."""

    add_after: float
    """ADD-0.1d of the other in percent."""

    add_gain: Interval
    """95 % interval of the difference, in percentage points; negative is a loss."""

    p_value: float
    """Probability of such a difference if both are equally good."""

    faster: float
    """Time of matching and pose of the one over that of the other."""

    faster_between: Interval
    """95 % interval of that."""

    smaller: float
    """Size of the map of the one over that of the other."""

    def to_json(self) -> dict:
        """As plain values."""
        names = ("method", "strategy", "variant")
        return {
            "object": self.object,
            "before": dict(zip(names, self.before, strict=True)),
            "after": dict(zip(names, self.after, strict=True)),
            "queries": self.queries,
            "add_0.1d_before": self.add_before,
            "add_0.1d_after": self.add_after,
            "add_gain_low": self.add_gain.low,
            "add_gain_high": self.add_gain.high,
            "p_value": self.p_value,
            "faster": self.faster,
            "faster_low": self.faster_between.low,
            "faster_high": self.faster_between.high,
            "smaller": self.smaller,
        }


def compare_cells(name: str, pairs: Sequence[tuple[Cell, Cell]]) -> Comparison:
    """Compare two lines over one or several objects.

    Args:
        name: Of the object, or of all.
        pairs: For each object the cell that is compared with, and the one that is compared, of equal queries.
    """
    groups = [np.column_stack([_values(before), _values(after)]) for before, after in pairs]
    weights = np.array([len(group) for group in groups]) / sum(len(group) for group in groups)

    def figures(means: Float64[np.ndarray, "r g k"]) -> Float64[np.ndarray, "r figures"]:
        right_before, time_before, right_after, time_after = np.einsum("rgk,g->kr", means, weights)
        return np.column_stack([100 * (right_after - right_before), time_before / time_after])

    gain, faster = bootstrap(groups, figures)
    values = np.concatenate(groups)
    right_before, time_before, right_after, time_after = values.mean(axis=0).tolist()
    return Comparison(
        object=name,
        before=pairs[0][0].key,
        after=pairs[0][1].key,
        queries=len(values),
        add_before=100 * right_before,
        add_after=100 * right_after,
        add_gain=gain,
        p_value=paired_p_value(values[:, 2], values[:, 0]),
        faster=time_before / time_after,
        faster_between=faster,
        smaller=_bytes([one for one, _ in pairs]) / _bytes([one for _, one in pairs]),
    )


def _values(cell: Cell) -> Float64[np.ndarray, "queries 2"]:
    """Whether each query is right, and its time of matching and pose."""
    outcomes = cell.outcomes
    right, seconds = outcomes.error < ADD_FRACTIONS[0], outcomes.seconds[:, 1:].sum(axis=1)
    return np.column_stack([per_query(cell, right), per_query(cell, seconds)])


def _bytes(cells: Sequence[Cell]) -> float:
    return float(np.mean([np.mean([trial.map_bytes for trial in cell.trials]) for cell in cells]))


def against_full(results: Sequence[ObjectResult]) -> list[Comparison]:
    """Every line against the full map of the same method and strategy, of each object and over all.

    Points for direct matching stand against the full map matched exhaustively, where that was done: it is
    what they take the place of.
    """
    found = [
        (result.name, before, cell)
        for result in results
        for cell in result.cells
        if (before := _counterpart(result, cell))
    ]
    return _compare_all(found)


def compare_runs(before: Run, after: Run) -> list[Comparison]:
    """Every line that two runs have in common, on the objects whose queries are the same.

    Raises:
        InputError: They have nothing in common.
    """
    known = {one.name: one for one in before.objects}
    found = [
        (one.name, old, cell)
        for one in after.objects
        if one.name in known and _names(known[one.name]) == _names(one)
        for cell in one.cells
        if (old := known[one.name].cell(*cell.key))
    ]
    if not found:
        raise InputError(
            f"{before.folder} and {after.folder}: have no object with the same queries and no line in common"
        )
    return _compare_all(found)


def _names(result: ObjectResult) -> list[str]:
    return [query.path.name for query in result.queries]


def _compare_all(found: Sequence[tuple[str, Cell, Cell]]) -> list[Comparison]:
    """Over all objects first, where there are several, then of each."""
    by_line: dict[tuple[Key, Key], list[tuple[Cell, Cell]]] = {}
    for _, before, after in found:
        by_line.setdefault((before.key, after.key), []).append((before, after))
    overall = [compare_cells(BY_FRAME, pairs) for pairs in by_line.values() if len(pairs) > 1]
    return overall + [compare_cells(name, [(before, after)]) for name, before, after in found]


def _counterpart(result: ObjectResult, cell: Cell) -> Cell | None:
    if cell.variant == "full":
        return None
    strategies = [cell.strategy]
    if cell.variant == "default" or cell.variant.startswith("points"):
        strategies = ["exhaustive", cell.strategy]
    known = (result.cell(cell.method, strategy, "full") for strategy in strategies)
    return next((one for one in known if one), None)
