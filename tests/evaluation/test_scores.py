import numpy as np
import pytest
from handmade import outcomes_like

from slimsfm.evaluation.results import join_outcomes
from slimsfm.evaluation.scores import criteria, mean_scores, score


def test_scores_sum_up_mixed_outcomes():
    """Relative errors, also as meters, and times 100 as degrees."""
    quick, slow = (0.01, 0.02, 0.005), (0.06, 0.12, 0.005)
    found = [outcomes_like([0.005, 0.03, 0.2, np.inf], seconds=quick), outcomes_like([np.inf], seconds=slow)]
    scores = score(join_outcomes(found), metric=True)
    assert scores.queries == 5
    assert scores.localized == 60.0
    assert scores.add == {0.1: 40.0, 0.05: 40.0, 0.02: 20.0}
    assert scores.deg_cm == {1: 20.0, 3: 40.0, 5: 40.0}
    assert scores.median_error == 0.2
    assert scores.confidence_wrong == pytest.approx(1 / 3)
    assert scores.references_tried == 3
    assert scores.seconds.extract == pytest.approx(0.02)
    assert scores.seconds.match == pytest.approx(0.04)
    assert scores.seconds.pose == pytest.approx(0.005)
    assert scores.fps == pytest.approx(1 / 0.065)


def test_queries_of_several_draws_are_counted_once():
    outcomes = outcomes_like([0.01, 0.01, np.inf, 0.01])
    assert score(outcomes, metric=True, draws=2).queries == 2
    assert score(outcomes, metric=True, draws=2).localized == 75.0


def test_without_a_metric_unit_there_are_no_centimeters():
    scores = score(outcomes_like([0.0]), metric=False)
    assert scores.deg_cm is None
    assert set(criteria(metric=False)) == {"localized", "add_0.1d", "add_0.05d", "add_0.02d"}


def test_the_median_is_infinite_unless_more_than_half_are_localized():
    assert np.isinf(score(outcomes_like([0.01, 0.01, np.inf, np.inf]), metric=False).median_error)
    most = score(outcomes_like([0.01, 0.02, 0.04, np.inf]), metric=False)
    assert most.median_error == pytest.approx(0.03)


def test_without_any_pose_everything_fails_and_no_pose_is_sure():
    scores = score(outcomes_like([np.inf, np.inf]), metric=True)
    assert scores.localized == 0.0
    assert scores.add == {0.1: 0.0, 0.05: 0.0, 0.02: 0.0}
    assert scores.deg_cm == {1: 0.0, 3: 0.0, 5: 0.0}
    assert scores.confidence_wrong is None


def test_the_criteria_give_the_percentages_query_by_query():
    outcomes = outcomes_like([0.005, 0.02, 0.03, 0.05, 0.07, 0.1, np.inf])
    scores = score(outcomes, metric=True)
    percent = {name: 100 * fulfil(outcomes).mean() for name, fulfil in criteria(metric=True).items()}
    assert percent == {
        "localized": scores.localized,
        **{f"add_{fraction}d": value for fraction, value in scores.add.items()},
        **{f"{n}deg_{n}cm": value for n, value in (scores.deg_cm or {}).items()},
    }


def test_the_mean_of_one_object_is_its_score():
    one = score(outcomes_like([0.01, 0.04, np.inf]), metric=True)
    assert mean_scores([one]) == one


def test_means_weigh_objects_equally_and_use_the_median_of_medians():
    scores = [
        score(outcomes_like([0.01] * 4, seconds=(0.01, 0.02, 0.01)), metric=True),
        score(outcomes_like([0.03], seconds=(0.01, 0.05, 0.01), references=6), metric=True),
        score(outcomes_like([np.inf] * 2, seconds=(0.01, 0.08, 0.01)), metric=True),
    ]
    mean = mean_scores(scores)
    assert mean.queries == 7
    assert mean.localized == pytest.approx(200 / 3)
    assert mean.add == pytest.approx({0.1: 200 / 3, 0.05: 200 / 3, 0.02: 100 / 3})
    assert mean.deg_cm == pytest.approx({1: 100 / 3, 3: 200 / 3, 5: 200 / 3})
    assert mean.median_error == pytest.approx(0.03)
    assert mean.confidence_wrong == 0.0  # over the two that have sure poses
    assert mean.references_tried == 4.0
    assert mean.seconds.match == pytest.approx(0.05)
    assert mean.fps == pytest.approx(1 / 0.07)


def test_one_object_of_unknown_unit_removes_centimeters_from_the_mean():
    known, unknown = (score(outcomes_like([0.01]), metric=metric) for metric in (True, False))
    assert mean_scores([known, unknown]).deg_cm is None


def test_a_mean_without_sure_poses_has_no_share_of_wrong_ones():
    assert mean_scores([score(outcomes_like([np.inf]), metric=True)] * 2).confidence_wrong is None
