"""How far figures can be trusted: bootstrap intervals, and a paired test between two variants.

A query that is localized against several draws of a random variant counts once, with its mean over the draws.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.stats import permutation_test

_RESAMPLES = 9999
_BLOCK = 1111
_COVERAGE = (2.5, 97.5)
_SEED = 0

Values = Float64[np.ndarray, "_ k"]
"""Some numbers a query; groups have as many queries as they have."""


@dataclass(frozen=True)
class Interval:
    """Where a figure lies with 95 % probability."""

    low: float
    """Lower end."""

    high: float
    """Upper end."""


def bootstrap(
    groups: Sequence[Values],
    figures: Callable[[Float64[np.ndarray, "resamples groups k"]], Float64[np.ndarray, "resamples figures"]],
) -> list[Interval]:
    """95 % percentile bootstrap intervals of figures made of means over queries.

    Queries are drawn anew, with replacement, within each group: the objects are those they are.

    Args:
        groups: Values of the queries of each object.
        figures: From the means of each group and value to the figures.
    """
    rng = np.random.default_rng(_SEED)
    means = np.stack([_resampled_means(values, rng) for values in groups], axis=1)
    low, high = np.percentile(figures(means), _COVERAGE, axis=0)
    return [Interval(float(a), float(b)) for a, b in zip(low, high, strict=True)]


def _resampled_means(values: Values, rng: np.random.Generator) -> Float64[np.ndarray, "resamples k"]:
    """In blocks, so that how often which query was drawn need not be known of all resamples at once."""
    n = len(values)
    return np.concatenate([_counts(n, rng) @ values / n for _ in range(_RESAMPLES // _BLOCK)])


def _counts(n: int, rng: np.random.Generator) -> Int64[np.ndarray, "block n"]:
    """How often each of n queries is drawn in each resample."""
    drawn = rng.integers(n, size=(_BLOCK, n)) + n * np.arange(_BLOCK)[:, None]
    return np.bincount(drawn.ravel(), minlength=_BLOCK * n).reshape(_BLOCK, n)


def paired_p_value(a: Float64[np.ndarray, " n"], b: Float64[np.ndarray, " n"]) -> float:
    """Probability that two variants differ by as much on the same queries if they are equally good.

    The sign-flip test: were they equally good, each query's difference could as well have the other sign.
    Where values are 0 or 1 this is McNemar's exact test. Exact up to 13 differing queries, else by 9999
    random flips.
    """
    differences = (a - b)[a != b]
    if len(differences) < 2:
        return 1.0  # either sign is as far from 0 as the other
    found = permutation_test(
        (differences,),
        np.mean,
        permutation_type="samples",
        n_resamples=_RESAMPLES,
        rng=np.random.default_rng(_SEED),
    )
    return float(found.pvalue)
