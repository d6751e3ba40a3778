"""Candidates with chosen figures."""

from dataclasses import replace

import numpy as np

from slimsfm.localization import Seconds
from slimsfm.reduction import Candidate, Choice, Frontier, Prediction

TESTS = 20
MISSED = 4  # by the full map


FULL_BYTES = 100_000
DIAGONAL = 2.0


def prediction(missed, seconds=0.01, error=0.001, rough=None):
    """A prediction of twenty tests: each missed test costs five percentage points.

    If `rough` is given, so many are missed after one disturbance.
    """
    errors = np.where(np.arange(TESTS) < missed, np.inf, error)
    tests = tuple(f"{i}.png" for i in range(TESTS))
    inliers = np.where(np.isfinite(errors), 30, 0).astype(np.int64)
    columns = [] if rough is None else [np.where(np.arange(TESTS) < rough, np.inf, error)]
    return Prediction(
        tests=tests,
        errors=errors,
        inliers=inliers,
        seconds=Seconds(extract=0.0, match=0.75 * seconds, pose=0.25 * seconds),
        rough_errors=np.array(columns, np.float64).reshape(len(columns), TESTS).T,
    )


FULL = prediction(MISSED, seconds=1.0)
FULL_ROUGH = prediction(MISSED, seconds=1.0, rough=MISSED)


def candidate(
    *,
    use="direct",
    method="kcover",
    points=100,
    images=0,
    size=1000,
    missed=0,
    ms=10.0,
    error=0.001,
    rough=None,
):
    """A candidate that misses `missed` more tests than the full map, and `rough` more after a disturbance."""
    return Candidate(
        choice=Choice(
            use=use,
            method=method,
            detail=f"{points} points",
            images=tuple(f"{i}.png" for i in range(images)),
            points=np.arange(points),
        ),
        bytes=size,
        prediction=prediction(
            MISSED + missed,
            seconds=1e-3 * ms,
            error=error,
            rough=None if rough is None else MISSED + rough,
        ),
        full=FULL if rough is None else FULL_ROUGH,
    )


def with_errors(one, median, p90, full_median=0.001, full_p90=0.002, finest=0.0):
    """The candidate, of given corner errors, where all tests have a pose with it and with the full map."""

    def prediction_of(found, middle, high):
        errors = np.where(np.arange(TESTS) < 0.8 * TESTS, middle, high)
        return replace(found, errors=errors, finest_error=finest)

    return replace(
        one,
        prediction=prediction_of(one.prediction, median, p90),
        full=prediction_of(one.full, full_median, full_p90),
    )


def frontier_of(*candidates):
    return Frontier(full=FULL, candidates=candidates, bytes=FULL_BYTES, diagonal=DIAGONAL)
