"""Calibration of confidences and its chart."""

import numpy as np
import pytest
from charting import drawn, outcomes, texts
from scipy.stats import binomtest

from slimsfm.report.reliability import calibration, reliability_chart, wilson_interval

SOME = outcomes(
    errors=[0.01, 0.02, 0.03, 0.2, 0.05, 0.5, np.inf],
    confidence=[0.95, 0.95, 0.95, 0.95, 0.55, 0.55, np.nan],
)


def test_calibration_equals_manual_computation():
    found = calibration(SOME)
    assert found.counts.tolist() == [0, 0, 0, 0, 0, 2, 0, 0, 0, 4]
    assert (found.poses, found.without) == (6, 1)
    assert found.right[[5, 9]].tolist() == [0.5, 0.75]
    np.testing.assert_allclose(found.confidence[[5, 9]], [0.55, 0.95])
    assert np.isnan(found.right[0])
    assert found.expected_error == pytest.approx((4 * 0.2 + 2 * 0.05) / 6)
    assert found.brier == pytest.approx((3 * 0.05**2 + 0.95**2 + 0.45**2 + 0.55**2) / 6)


def test_an_error_of_a_tenth_is_wrong_and_confidences_of_0_and_1_are_in_bins():
    found = calibration(outcomes([0.1, 0.0999], [0.0, 1.0]))
    assert found.counts.tolist() == [1, *[0] * 8, 1]
    assert found.right[[0, 9]].tolist() == [0.0, 1.0]
    assert (found.expected_error, found.brier) == (0.0, 0.0)


@pytest.mark.parametrize(("right", "count"), [(0, 1), (3, 4), (7, 7), (41, 60)])
def test_intervals_equal_scipys_wilson_intervals(right, count):
    expected = binomtest(right, count).proportion_ci(method="wilson")
    low, high = wilson_interval(np.array([right / count]), np.array([count]))
    assert (low[0], high[0]) == (pytest.approx(expected.low, abs=1e-12), pytest.approx(expected.high))


def test_the_reliability_chart_shows_the_calibration():
    shares, counts = reliability_chart(SOME).axes
    assert drawn(shares, "calibrated") == [[[0, 0], [1, 1]]]
    (bars,) = shares.containers
    np.testing.assert_allclose(bars.lines[0].get_xydata(), [[0.55, 0.5], [0.95, 0.75]])
    found = calibration(SOME)
    ends = [segment[:, 1] for segment in bars.lines[2][0].get_segments()]
    np.testing.assert_allclose(ends, np.stack([found.low, found.high], axis=1)[[5, 9]])
    assert [bar.get_height() for bar in counts.patches] == found.counts.tolist()
    assert [text for text in texts(counts) if text] == ["2", "4"]
    said = shares.get_title(loc="left")
    for words in ("6 poses, 1 query without", "calibration error 0.150", f"Brier score {found.brier:.3f}"):
        assert words in said


def test_a_reliability_chart_without_poses_says_so():
    shares, _ = reliability_chart(outcomes([np.inf] * 2, [np.nan] * 2)).axes
    assert shares.get_title(loc="left") == "0 poses, 2 queries without"
