"""Compare rows of the table on the same queries, and summarize dominating sets."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float64

from slimsfm.errors import InputError
from slimsfm.evaluation.results import Measurement, ObjectResult, Run
from slimsfm.evaluation.scores import Interval, bootstrap, paired_p_value
from slimsfm.evaluation.table import BY_FRAME, mean_over_draws
from slimsfm.geometry import ADD_FRACTIONS

MeasurementKey = tuple[str, str, str]
"""Method, strategy and variant."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Two rows of the table, compared query by query."""

    object: str
    """Name of the object, or `BY_FRAME`."""

    before: MeasurementKey
    """The baseline."""

    after: MeasurementKey
    """The row that is compared with the baseline."""

    queries: int
    """Number of common queries."""

    add_before: float
    """ADD-0.1d of the baseline, in percent."""

    add_after: float
    """ADD-0.1d of the other row, in percent."""

    add_gain: Interval
    """95 % interval of the difference, in percentage points; negative is a loss."""

    p_value: float
    """Probability of such a difference if both are equally good."""

    faster: float
    """Speedup: time of matching and pose estimation of the baseline, divided by that of the other row."""

    faster_between: Interval
    """95 % interval of the speedup."""

    faster_whole: float
    """Speedup of the whole query, with the extraction of features."""

    smaller: float
    """Size of the map of the baseline, divided by that of the other row."""

    def to_json(self) -> dict:
        """Plain values by their names in `results.json`."""
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
            "faster_whole": self.faster_whole,
            "smaller": self.smaller,
        }


def compare_measurements(name: str, pairs: Sequence[tuple[Measurement, Measurement]]) -> Comparison:
    """Compare two rows over one or several objects.

    Args:
        name: Name of the object, or of the average.
        pairs: For each object, the baseline and the other measurement, of the same queries.
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
        faster_whole=_whole_seconds([one for one, _ in pairs]) / _whole_seconds([one for _, one in pairs]),
        smaller=_map_bytes([one for one, _ in pairs]) / _map_bytes([one for _, one in pairs]),
    )


def _values(one: Measurement) -> Float64[np.ndarray, "queries 2"]:
    """Per query: whether the pose is correct, and the time of matching and pose estimation."""
    outcomes = one.outcomes
    right, seconds = outcomes.error < ADD_FRACTIONS[0], outcomes.seconds[:, 1:].sum(axis=1)
    return np.column_stack([mean_over_draws(one, right), mean_over_draws(one, seconds)])


def _whole_seconds(some: Sequence[Measurement]) -> float:
    return float(
        np.concatenate([mean_over_draws(one, one.outcomes.seconds.sum(axis=1)) for one in some]).mean()
    )


def _map_bytes(some: Sequence[Measurement]) -> float:
    return float(np.mean([np.mean([run.map_bytes for run in one.map_runs]) for one in some]))


def against_full(results: Sequence[ObjectResult]) -> list[Comparison]:
    """Compare every row with the full map of the same method and strategy, per object and over all objects.

    Maps for direct matching are compared with exhaustive matching against the full map if that was measured,
    because they replace it.
    """
    found = [
        (result.name, before, one)
        for result in results
        for one in result.measurements
        if (before := _baseline(result, one))
    ]
    return _compare_all(found)


def compare_runs(before: Run, after: Run) -> list[Comparison]:
    """Compare the rows that two runs share, on the objects with the same queries.

    Raises:
        InputError: The runs share no row.
    """
    known = {one.name: one for one in before.objects}
    found = [
        (one.name, old, new)
        for one in after.objects
        if one.name in known and _query_names(known[one.name]) == _query_names(one)
        for new in one.measurements
        if (old := known[one.name].measurement(*new.key))
    ]
    if not found:
        raise InputError(
            f"{before.folder} and {after.folder}: the runs have no row in common on an object with the same "
            "queries"
        )
    return _compare_all(found)


def _query_names(result: ObjectResult) -> list[str]:
    return [query.path.name for query in result.queries]


def _compare_all(found: Sequence[tuple[str, Measurement, Measurement]]) -> list[Comparison]:
    """Over all objects first if there are several, then per object."""
    by_row: dict[tuple[MeasurementKey, MeasurementKey], list[tuple[Measurement, Measurement]]] = {}
    for _, before, after in found:
        by_row.setdefault((before.key, after.key), []).append((before, after))
    overall = [compare_measurements(BY_FRAME, pairs) for pairs in by_row.values() if len(pairs) > 1]
    return overall + [compare_measurements(name, [(before, after)]) for name, before, after in found]


def _baseline(result: ObjectResult, one: Measurement) -> Measurement | None:
    if one.variant == "full":
        return None
    strategies = [one.strategy]
    if one.variant == "default" or one.variant.startswith("points"):
        strategies = ["exhaustive", one.strategy]
    known = (result.measurement(one.method, strategy, "full") for strategy in strategies)
    return next((found for found in known if found), None)


@dataclass(frozen=True, kw_only=True)
class DominationSummary:
    """Sizes of the dominating sets of one method over all objects."""

    method: str
    """Name of the method."""

    objects: int
    """Number of objects."""

    smallest: int
    """Number of images in the smallest set."""

    mean: float
    """Mean number of images in a set."""

    largest: int
    """Number of images in the largest set."""

    images_kept_mean: float
    """Share of the reference images that the set keeps, mean over objects."""

    images_kept_median: float
    """Share of the reference images that the set keeps, median over objects."""

    points_kept_mean: float
    """Share of the points that the set keeps, mean over objects."""

    points_kept_median: float
    """Share of the points that the set keeps, median over objects."""

    def to_json(self) -> dict:
        """Plain values by their names in `results.json`."""
        return asdict(self)


def summarize_domination(results: Sequence[ObjectResult]) -> list[DominationSummary]:
    """Sizes of the dominating sets, one summary per method: the figures in the paper's text."""
    methods = dict.fromkeys(one.method for result in results for one in result.maps)
    return [_summary(method, results) for method in methods]


def _summary(method: str, results: Sequence[ObjectResult]) -> DominationSummary:
    maps = [one for result in results for one in result.maps if one.method == method]
    sizes = np.array([len(one.dominating_set) for one in maps])
    images = sizes / [one.references for one in maps]
    points = np.array([one.dominating_points / one.points for one in maps])
    return DominationSummary(
        method=method,
        objects=len(maps),
        smallest=int(sizes.min()),
        mean=float(sizes.mean()),
        largest=int(sizes.max()),
        images_kept_mean=float(images.mean()),
        images_kept_median=float(np.median(images)),
        points_kept_mean=float(points.mean()),
        points_kept_median=float(np.median(points)),
    )
