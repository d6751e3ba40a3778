import numpy as np
import pytest

from disturbed_report import Record, calibration_error, coverage, missed_targets


def record(confidence, error, *, disturbance="zoom2", group="zoom", has_pose=True, bound=None):
    return Record(
        scene="scene",
        method="method",
        disturbance=disturbance,
        group=group,
        query="query",
        has_pose=has_pose,
        confidence=confidence,
        error=error,
        bound=bound,
        relative_focal_error=0.0,
        inliers=20,
        milliseconds=1.0,
    )


@pytest.mark.parametrize("confidence", [0.05, 0.25, 0.75, 0.97])
def test_confidence_that_equals_the_share_of_right_poses_is_calibrated(confidence):
    right = round(100 * confidence)
    records = [record(confidence, 0.01 if index < right else np.inf) for index in range(100)]
    assert calibration_error(records) == pytest.approx(0, abs=1e-9)
    assert calibration_error([record(confidence, np.inf)]) == pytest.approx(confidence)


def test_only_what_misses_a_target_is_named():
    good = [record(0.98, 0.01)] * 20
    assert missed_targets(good) == []
    assert len(missed_targets([*good, *[record(0.98, 0.5)] * 2])) == 1
    assert len(missed_targets([*good, *[record(0.1, 0.5)] * 6])) == 1
    strange = [record(0.6, np.inf, disturbance="mirrored", group="mirrored", has_pose=False)]
    unfound = [record(0.1, np.inf, disturbance="mirrored", group="mirrored", has_pose=False)]
    assert missed_targets(strange + 99 * unfound) == []
    assert len(missed_targets(2 * strange + 98 * unfound)) == 1


def test_coverage_counts_poses_that_can_be_right_and_have_a_bound():
    held, broken = record(0.9, 0.01, bound=0.02), record(0.9, 0.03, bound=0.02)
    others = [record(0.9, 0.01), record(0.9, np.inf, has_pose=False, bound=0.1)]
    assert coverage([held, held, held, broken, *others]) == "75% of 4"
    assert coverage(others) == ""
