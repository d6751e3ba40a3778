"""Scores of many outcomes, with bootstrap intervals and a paired test.

A query that is localized against several draws of a random variant counts once, with its mean over the draws.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.stats import permutation_test

from slimsfm.evaluation.results import Outcomes
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.localization import Seconds

DEG_CM = (1, 3, 5)
"""The thresholds n of the criterion "n degrees and n cm"."""

SURE = 0.9
"""A pose with a confidence above this counts as sure."""

_RESAMPLES = 9999
_BLOCK = 1111
_COVERAGE = (2.5, 97.5)
_SEED = 0

Criterion = Callable[[Outcomes], Bool[np.ndarray, " n"]]
"""Marks the queries that meet a condition."""

ValuesPerQuery = Float64[np.ndarray, "_ k"]
"""k numbers per query; groups may differ in their number of queries."""


def add_percent(errors: Float64[np.ndarray, " n"], fraction: float) -> float:
    """Modified ADD: percentage of queries whose relative error is below a fraction of the diagonal.

    The paper replaces the mean distance of the points of a model by that of the corners of the box, and calls
    the longest diagonal of the box the diameter d. With fraction 0.1 this is its ADD-0.1d. A query without a
    pose fails.
    """
    return 100 * float(np.mean(errors < fraction))


def deg_cm_percent(
    rotations_deg: Float64[np.ndarray, " n"], translations_in_meters: Float64[np.ndarray, " n"], n: int
) -> float:
    """Percentage of queries within both n degrees and n cm; a query without a pose fails."""
    return 100 * float(np.mean(within_deg_cm(rotations_deg, translations_in_meters, n)))


def within_deg_cm(
    rotations_deg: Float64[np.ndarray, " n"], translations_in_meters: Float64[np.ndarray, " n"], n: int
) -> np.ndarray:
    """Marks the queries within both n degrees and n cm."""
    return (rotations_deg <= n) & (100 * translations_in_meters <= n)


def wrong_when_sure(
    errors: Float64[np.ndarray, " n"], confidence: Float64[np.ndarray, " n"], fraction: float
) -> float | None:
    """Share of wrong poses among those whose confidence is above `SURE`; None if there is no such pose.

    The confidence is the probability that the corner error is below a tenth of the diagonal, so at most a
    tenth of these poses should be wrong.
    """
    sure = confidence > SURE  # NaN, no confidence, is not
    return float(np.mean(errors[sure] >= fraction)) if sure.any() else None


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of a set of queries. Percentages are of all queries."""

    queries: int
    """Number of queries."""

    localized: float
    """Percentage with a pose, correct or not."""

    add: dict[float, float]
    """Percentage within each of `ADD_FRACTIONS` of the diagonal."""

    median_error: float
    """Median relative error; infinite unless more than half of the queries have a pose."""

    deg_cm: dict[int, float] | None
    """Percentage within n degrees and n cm for each of `DEG_CM`; None if the unit is unknown."""

    confidence_wrong: float | None
    """Share of poses that are off by a tenth of the diagonal or more, among the sure ones; None if no pose is
    sure."""

    references_tried: float
    """Mean number of reference images that a query was matched with."""

    seconds: Seconds
    """Mean time per query."""

    @property
    def fps(self) -> float:
        """Queries per second, all stages together."""
        return 1 / self.seconds.total


def score(outcomes: Outcomes, *, metric: bool, draws: int = 1) -> Scores:
    """Compute the scores of outcomes.

    Args:
        outcomes: Outcomes of the queries.
        metric: Whether the unit of the map is the meter.
        draws: How many times each query occurs.
    """
    extract, match, pose = outcomes.seconds.mean(axis=0).tolist()
    return Scores(
        queries=len(outcomes) // draws,
        localized=100 * float(np.mean(np.isfinite(outcomes.error))),
        add={fraction: add_percent(outcomes.error, fraction) for fraction in ADD_FRACTIONS},
        median_error=float(np.median(outcomes.error)),
        deg_cm={n: deg_cm_percent(outcomes.rotation_deg, outcomes.translation, n) for n in DEG_CM}
        if metric
        else None,
        confidence_wrong=wrong_when_sure(outcomes.error, outcomes.confidence, ADD_FRACTIONS[0]),
        references_tried=float(np.mean(outcomes.references)),
        seconds=Seconds(extract=extract, match=match, pose=pose),
    )


def criteria(*, metric: bool) -> dict[str, Criterion]:
    """The criteria of the percentages in the table, by their names in `results.json`."""
    found: dict[str, Criterion] = {"localized": lambda one: np.isfinite(one.error)}
    found |= {f"add_{fraction}d": _closer_than(fraction) for fraction in ADD_FRACTIONS}
    return found | ({f"{n}deg_{n}cm": _within(n) for n in DEG_CM} if metric else {})


def _closer_than(fraction: float) -> Criterion:
    return lambda one: one.error < fraction


def _within(n: int) -> Criterion:
    return lambda one: within_deg_cm(one.rotation_deg, one.translation, n)


def mean_scores(scores: Sequence[Scores]) -> Scores:
    """Mean over objects with equal weights; for the median error, the median of the medians."""
    seconds = [one.seconds for one in scores]
    metric = all(one.deg_cm is not None for one in scores)
    return Scores(
        queries=sum(one.queries for one in scores),
        localized=_mean([one.localized for one in scores]),
        add={fraction: _mean([one.add[fraction] for one in scores]) for fraction in ADD_FRACTIONS},
        median_error=float(np.median([one.median_error for one in scores])),
        deg_cm={n: _mean([(one.deg_cm or {})[n] for one in scores]) for n in DEG_CM} if metric else None,
        confidence_wrong=_mean_of_known([one.confidence_wrong for one in scores]),
        references_tried=_mean([one.references_tried for one in scores]),
        seconds=Seconds(
            extract=_mean([one.extract for one in seconds]),
            match=_mean([one.match for one in seconds]),
            pose=_mean([one.pose for one in seconds]),
        ),
    )


def _mean(values: Sequence[float | int]) -> float:
    return float(np.mean(values))


def _mean_of_known(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return _mean(known) if known else None


@dataclass(frozen=True)
class Interval:
    """A 95 % interval."""

    low: float
    """Lower end."""

    high: float
    """Upper end."""


def bootstrap(
    groups: Sequence[ValuesPerQuery],
    figures: Callable[[Float64[np.ndarray, "resamples groups k"]], Float64[np.ndarray, "resamples figures"]],
) -> list[Interval]:
    """95 % percentile bootstrap intervals of figures that are functions of means over queries.

    Each group is resampled on its own, with replacement: queries vary, the set of objects does not.

    Args:
        groups: Values of the queries of each object.
        figures: Maps the means of each group and value to the figures.
    """
    rng = np.random.default_rng(_SEED)
    means = np.stack([_resampled_means(values, rng) for values in groups], axis=1)
    low, high = np.percentile(figures(means), _COVERAGE, axis=0)
    return [Interval(float(a), float(b)) for a, b in zip(low, high, strict=True)]


def _resampled_means(values: ValuesPerQuery, rng: np.random.Generator) -> Float64[np.ndarray, "resamples k"]:
    """Computed in blocks, which limits the memory for the counts."""
    n = len(values)
    return np.concatenate([_counts(n, rng) @ values / n for _ in range(_RESAMPLES // _BLOCK)])


def _counts(n: int, rng: np.random.Generator) -> Int64[np.ndarray, "block n"]:
    """How many times each resample draws each of n queries."""
    drawn = rng.integers(n, size=(_BLOCK, n)) + n * np.arange(_BLOCK)[:, None]
    return np.bincount(drawn.ravel(), minlength=_BLOCK * n).reshape(_BLOCK, n)


def paired_p_value(a: Float64[np.ndarray, " n"], b: Float64[np.ndarray, " n"]) -> float:
    """Probability of a difference at least this large on the same queries if both variants are equally good.

    This is the sign-flip test: under the hypothesis, each difference has either sign with equal probability.
    For values 0 and 1 it is the exact McNemar test. It is exact for up to 13 differing queries and uses 9999
    random flips beyond.
    """
    differences = (a - b)[a != b]
    if len(differences) < 2:
        return 1.0  # both signs are equally far from 0
    found = permutation_test(
        (differences,),
        np.mean,
        permutation_type="samples",
        n_resamples=_RESAMPLES,
        rng=np.random.default_rng(_SEED),
    )
    return float(found.pvalue)
