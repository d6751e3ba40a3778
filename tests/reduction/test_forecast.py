"""References that are left out predict queries."""

from dataclasses import replace
from itertools import count, pairwise

import numpy as np
import pytest

from scenes import exact_map
from slimsfm.features import unit_rows
from slimsfm.localization import Seconds
from slimsfm.pose import RansacOptions
from slimsfm.reduction import Prediction, Trials
from slimsfm.reduction.disturbance import ROUGH
from slimsfm.reduction.forecast import handicap
from slimsfm.selection.usable_points import LeftOut

LOST_AT_MOST = 0.5


def trials_of(map_):
    return Trials(map_, LeftOut(map_))


def rows_of(map_):
    return np.arange(len(map_.point3D_ids))


@pytest.fixture(scope="module")
def partial():
    """Ten images that see half of the points each."""
    return exact_map(10, 200, reach_deg=80)


@pytest.fixture(scope="module")
def strangers(exact):
    """The exact scene with random descriptors, different in every image."""
    rng = np.random.default_rng(0)
    features = {
        name: replace(one, descriptors=unit_rows(rng.normal(size=one.descriptors.shape)))
        for name, one in exact.features.items()
    }
    return replace(exact, features=features)


def timed_trials(map_):
    """Trials whose clock says that every stage of every test takes one second."""
    ticks = count()
    return Trials(map_, LeftOut(map_), extract_seconds=lambda _: 5.0, clock=lambda: float(next(ticks)))


def prediction(errors, inliers=None):
    return Prediction(
        tests=tuple(f"{i}.png" for i in range(len(errors))),
        errors=np.array(errors, np.float64),
        inliers=np.array(inliers if inliers is not None else [9] * len(errors), np.int64),
        seconds=Seconds(extract=0.3, match=0.1, pose=0.1),
        rough_errors=np.zeros((len(errors), 0)),
    )


def test_the_90th_percentile_counts_what_has_no_pose():
    assert prediction([*np.arange(1, 11) / 100, np.inf]).p90_error == pytest.approx(0.1)
    assert prediction([*np.arange(1, 10) / 100, np.inf, np.inf]).p90_error == np.inf
    assert prediction([]).p90_error == np.inf


def test_shares_count_errors_below_a_fraction():
    found = prediction([0.0, 0.01, 0.02, np.inf])
    assert [found.within(one) for one in (0.005, 0.02, 0.03)] == [25.0, 50.0, 75.0]
    assert found.median_error == pytest.approx(0.015)
    assert prediction([np.inf, np.inf, 0.1]).median_error == np.inf


def test_a_prediction_can_be_restricted_to_some_tests():
    found = prediction([0.1, 0.2, 0.3], [5, 6, 7])
    part = found.of({"2.png", "0.png", "missing.png"})
    assert part.tests == ("0.png", "2.png")
    assert part.errors.tolist() == [0.1, 0.3]
    assert part.inliers.tolist() == [5, 7]
    assert part.seconds == found.seconds
    assert found.of(found.tests).errors.tolist() == found.errors.tolist()


def test_without_tests_nothing_is_predicted():
    nothing = prediction([0.1]).of(())
    assert nothing.tests == ()
    assert nothing.within(0.1) == 0.0
    assert nothing.median_error == np.inf


def test_on_an_exact_scene_all_errors_are_zero(exact):
    trials, names = trials_of(exact), list(exact.images)
    assert trials.tests == tuple(names)
    by_points, by_images = trials.points(rows_of(exact)), trials.images(names[:2])
    everything = trials.full(names)
    assert by_points.tests == everything.tests == tuple(names)
    assert by_images.tests == tuple(names[2:])
    for found in (by_points, by_images, everything):
        assert found.errors.max() < 1e-4
        assert found.within(0.02) == 100.0
        assert found.inliers.min() >= (LOST_AT_MOST - 0.15) * len(exact.point3D_ids)
        assert min(found.seconds.match, found.seconds.pose) > 0
        assert np.isnan(found.seconds.total)  # nobody said how long extraction takes


def test_a_reference_does_not_help_to_localize_itself(strangers):
    trials = trials_of(strangers)
    for found in (trials.points(rows_of(strangers)), trials.full(trials.tests)):
        assert found.inliers.tolist() == [0] * len(trials.tests)
        assert found.within(1e9) == 0.0


def test_only_some_are_left_out_where_there_are_many():
    many = exact_map(70, 30)
    trials, names = timed_trials(many), list(many.images)
    assert len(set(trials.tests)) == 60
    assert list(trials.tests) == sorted(trials.tests)
    assert (trials.tests[0], trials.tests[-1]) == (names[0], names[-1])
    by_images = trials.images(names[:30]).tests
    assert set(by_images) == set(trials.tests) - set(names[:30])
    assert trials.points(rows_of(many)).seconds == Seconds(extract=5.0, match=1.0, pose=1.0)
    scaled = trials.full(trials.tests[:3]).seconds
    assert (scaled.extract, scaled.match, scaled.pose) == pytest.approx((5.0, 69 / 60, 69 / 60))


def test_the_time_of_a_full_map_is_measured_where_images_are_few(exact):
    found = timed_trials(exact).full(list(exact.images)[:2])
    assert found.seconds == Seconds(extract=5.0, match=1.0, pose=1.0)


def test_equal_maps_give_equal_predictions(partial):
    rows = rows_of(partial)[::2]
    one, two = trials_of(partial), trials_of(partial)
    two.points(rows_of(partial))  # what was asked before does not matter
    names = list(partial.images)[:3]
    for a, b in (
        (one.points(rows), two.points(rows)),
        (one.images(names), two.images(names[::-1])),
        (one.full(one.tests), two.full(two.tests)),
    ):
        assert a.tests == b.tests
        assert np.array_equal(a.errors, b.errors)
        assert np.array_equal(a.inliers, b.inliers)


def test_the_finest_error_is_half_a_pixel_at_the_distance_of_the_points(exact):
    camera, diagonal = exact.camera(next(iter(exact.images))), exact.box.diagonal
    distances = [np.linalg.norm(image.projection_center()) for image in exact.images.values()]
    found = trials_of(exact).points(rows_of(exact)).finest_error
    expected = 0.5 * np.median(distances) / (camera.mean_focal_length() * diagonal)
    assert found == pytest.approx(expected, rel=0.05)


def test_rough_queries_are_predicted_only_on_request(partial):
    rows = rows_of(partial)
    rough, clean = trials_of(partial), Trials(partial, LeftOut(partial), conditions="clean")
    found, plain = rough.points(rows), clean.points(rows)
    assert np.array_equal(found.errors, plain.errors)
    assert found.rough_errors.shape == (len(found.tests), len(ROUGH))
    assert plain.rough_within(0.1) == ()
    again = trials_of(partial).points(rows)
    assert np.array_equal(found.rough_errors, again.rough_errors)


def test_rough_queries_need_more_points(partial):
    order = np.random.default_rng(0).permutation(rows_of(partial))
    many, few = (trials_of(partial).points(np.sort(order[:size])) for size in (200, 60))
    assert np.mean(few.rough_within(0.1)) < np.mean(many.rough_within(0.1)) <= many.within(0.1)
    assert np.mean(few.rough_within(0.1)) < few.within(0.1)


def test_fewer_points_give_no_more_inliers(partial):
    rng, trials = np.random.default_rng(0), trials_of(partial)
    order = rng.permutation(rows_of(partial))
    means = [trials.points(np.sort(order[:size])).inliers.mean() for size in (200, 120, 70, 40, 20)]
    assert all(more > fewer for more, fewer in pairwise(means))


def test_points_that_nobody_sees_localize_nobody(exact):
    found = trials_of(exact).points(np.array([3, 4, 5]))
    assert found.inliers.tolist() == [0] * len(exact.images)
    assert np.isinf(found.errors).all()


@pytest.mark.parametrize("test", range(20))
def test_wrong_matches_are_all_kept(test):
    assert handicap(np.full(400, 2 * RansacOptions().max_error_px), test).all()


def test_at_most_half_of_the_correct_matches_are_removed_on_average():
    kept = np.array([handicap(np.zeros(400), test).mean() for test in range(40)])
    assert kept[0] == 1.0
    assert kept.min() > LOST_AT_MOST - 0.1
    assert kept.mean() == pytest.approx(1 - LOST_AT_MOST / 2, abs=0.03)
    assert np.histogram(kept, bins=[0, 0.625, 0.75, 0.875, 1])[0].min() >= 6
