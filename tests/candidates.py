"""Candidates with chosen figures."""

import numpy as np

from slimsfm.reduction import Candidate, Choice, Frontier, Prediction

TESTS = 20
MISSED = 4  # by the full map


def prediction(missed, seconds=0.01, error=0.001):
    """A prediction of twenty tests: each missed test costs five percentage points."""
    errors = np.where(np.arange(TESTS) < missed, np.inf, error)
    tests = tuple(f"{i}.png" for i in range(TESTS))
    inliers = np.where(np.isfinite(errors), 30, 0).astype(np.int64)
    return Prediction(tests=tests, errors=errors, inliers=inliers, seconds=seconds)


FULL = prediction(MISSED, seconds=1.0)


def candidate(
    *, use="direct", method="kcover", points=100, images=0, size=1000, missed=0, ms=10.0, error=0.001
):
    """A candidate that misses `missed` more tests than the full map."""
    return Candidate(
        choice=Choice(
            use=use,
            method=method,
            detail=f"{points} points",
            images=tuple(f"{i}.png" for i in range(images)),
            points=np.arange(points),
        ),
        bytes=size,
        prediction=prediction(MISSED + missed, seconds=1e-3 * ms, error=error),
        full=FULL,
    )


def frontier_of(*candidates):
    return Frontier(full=FULL, candidates=candidates)
