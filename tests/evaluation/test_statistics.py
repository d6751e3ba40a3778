import numpy as np
import pytest
from scipy import stats

from slimsfm.evaluation.scores import bootstrap, paired_p_value


def means(found):
    """The figures are the means of the only group."""
    return found[:, 0, :]


def test_intervals_agree_with_scipy_on_skewed_values():
    """Both are random: with 9999 draws an end has an error of about 3 % of the standard error of the mean."""
    rng = np.random.default_rng(3)
    for n in (10, 60, 300):
        values = rng.lognormal(sigma=1.2, size=n)
        (ours,) = bootstrap([values[:, None]], means)
        theirs = stats.bootstrap(
            (values,), np.mean, method="percentile", n_resamples=9999, rng=np.random.default_rng(1)
        ).confidence_interval
        tolerance = 0.15 * values.std() / np.sqrt(n)
        assert ours.low == pytest.approx(theirs.low, abs=tolerance)
        assert ours.high == pytest.approx(theirs.high, abs=tolerance)
        assert values.mean() - ours.low < ours.high - values.mean()  # skewed as the values are


def test_each_group_is_resampled_on_its_own():
    """Two objects with constant outcomes: resampled together they would mix, here nothing varies."""
    groups = [np.zeros((5, 1)), np.full((9, 1), 100.0)]
    (interval,) = bootstrap(groups, lambda found: found.mean(axis=1))
    assert interval.low == interval.high == 50.0


def test_the_variance_of_a_mean_over_groups_is_that_of_their_means():
    rng = np.random.default_rng(4)
    groups = [rng.normal(0, 1, (200, 1)), rng.normal(5, 3, (100, 1))]
    (interval,) = bootstrap(groups, lambda found: found.mean(axis=1))
    deviation = 0.5 * np.sqrt(groups[0].var() / 200 + groups[1].var() / 100)
    assert interval.high - interval.low == pytest.approx(2 * 1.96 * deviation, rel=0.05)


@pytest.mark.parametrize("draw", ["normal", "uniform", "exponential"])
def test_about_95_percent_of_intervals_contain_the_true_mean(draw):
    """Every column is one study of 60 queries; for skewed values the intervals are slightly too short."""
    rng = np.random.default_rng(5)
    sample, truth = {
        "normal": (rng.normal(2.0, 1.0, (60, 400)), 2.0),
        "uniform": (rng.uniform(0.0, 1.0, (60, 400)), 0.5),
        "exponential": (rng.exponential(1.0, (60, 400)), 1.0),
    }[draw]
    found = bootstrap([sample], means)
    assert 0.90 <= np.mean([one.low <= truth <= one.high for one in found]) <= 0.98


def test_about_95_percent_of_intervals_contain_the_true_percentage():
    sample = 100.0 * (np.random.default_rng(6).random((100, 400)) < 0.8)
    found = bootstrap([sample], means)
    assert 0.90 <= np.mean([one.low <= 80 <= one.high for one in found]) <= 0.98


def test_equal_values_have_an_interval_of_zero_width():
    (interval,) = bootstrap([np.full((7, 1), 100.0)], means)
    assert interval.low == interval.high == 100.0
    (interval,) = bootstrap([np.full((7, 1), 0.1)], means)
    assert interval.high - interval.low < 1e-15
    (interval,) = bootstrap([np.array([[3.0]])], means)
    assert interval.low == interval.high == 3.0


def test_equal_values_give_equal_intervals_and_the_order_of_figures_is_kept():
    values = np.random.default_rng(7).normal(size=(20, 3))
    found = bootstrap([values], means)
    assert found == bootstrap([values.copy()], means)
    for one, mean in zip(found, values.mean(axis=0), strict=True):
        assert one.low < mean < one.high


@pytest.mark.parametrize("lost", range(14))
def test_for_zeros_and_ones_the_test_is_mcnemars(lost):
    """Only differing queries count, and both signs are equally probable."""
    for won in range(14 - lost):
        a = np.array([1.0] * lost + [0.0] * won + [1.0, 0.0, 0.0])
        b = np.array([0.0] * lost + [1.0] * won + [1.0, 0.0, 0.0])
        expected = stats.binomtest(lost, lost + won).pvalue if lost + won else 1.0
        assert paired_p_value(a, b) == pytest.approx(expected)


@pytest.mark.parametrize(("lost", "won"), [(10, 10), (8, 16), (20, 40)])
def test_with_many_queries_the_test_approximates_mcnemars(lost, won):
    a, b = np.repeat([1.0, 0.0], [lost, won]), np.repeat([0.0, 1.0], [lost, won])
    expected = stats.binomtest(lost, lost + won).pvalue
    assert paired_p_value(a, b) == pytest.approx(expected, abs=0.02)


def test_the_p_value_is_symmetric():
    rng = np.random.default_rng(8)
    for n in (2, 7, 13, 14, 50):
        a, b = rng.random(n), rng.random(n)
        assert paired_p_value(a, b) == pytest.approx(paired_p_value(b, a), abs=1e-12)


def test_equal_values_do_not_differ():
    values = np.random.default_rng(9).random(30)
    assert paired_p_value(values, values) == 1.0
    assert paired_p_value(values, np.append(values[:-1], 7.0)) == 1.0  # one query proves nothing


def test_means_over_draws_that_cancel_out_do_not_differ():
    """Means over five draws are fifths; their sum is 0 up to rounding."""
    a, b = np.array([0.6, 0.2, 0.8, 0.0]), np.array([0.0, 0.8, 0.2, 0.6])
    assert paired_p_value(a, b) == 1.0
    assert paired_p_value(b, a) == 1.0


def test_for_equally_good_variants_p_is_uniform():
    rng = np.random.default_rng(10)
    found = np.array([paired_p_value(rng.normal(size=7), rng.normal(size=7)) for _ in range(300)])
    for level in (0.05, 0.25, 0.5, 0.75):
        assert np.mean(found <= level) == pytest.approx(level, abs=0.08)


def test_more_evidence_has_a_smaller_p_value():
    found = [paired_p_value(np.ones(n), np.zeros(n)) for n in range(2, 14)]
    assert found == pytest.approx([2.0 ** (1 - n) for n in range(2, 14)])
    assert paired_p_value(np.ones(100), np.zeros(100)) < 0.001
