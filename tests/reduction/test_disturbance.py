"""Blur and occlusion remove matches as they do in photos."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slimsfm.reduction.disturbance import ROUGH, Disturbance, Keypoints, disturbed, kept_by_blur, remaining

SIZE = (640, 480)
MANY = 4000
SCALES = st.floats(0.3, 60)
BLURS = st.floats(0.2, 10)


@pytest.fixture(scope="module")
def keypoints():
    rng = np.random.default_rng(0)
    return Keypoints(pixels=rng.uniform(0, SIZE, (MANY, 2)), scales=rng.uniform(0.8, 12, MANY), size=SIZE)


def chance(scale, blur):
    return float(kept_by_blur(np.array([scale]), blur)[0])


@given(scale=SCALES, blur=BLURS, factor=st.floats(0.1, 10))
def test_only_the_scale_relative_to_the_blur_matters(scale, blur, factor):
    assert chance(factor * scale, factor * blur) == pytest.approx(chance(scale, blur))


@given(scale=SCALES, blur=BLURS, more=st.floats(1.01, 5))
def test_blur_removes_fine_keypoints_first_and_more_blur_more(scale, blur, more):
    assert 0 <= chance(scale, blur) <= chance(more * scale, blur) <= 1
    assert chance(scale, more * blur) <= chance(scale, blur)


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6])
@pytest.mark.parametrize("test", range(5))
def test_one_side_is_hidden(keypoints, share, test):
    found = remaining(keypoints, Disturbance(name="", hidden=share), test)
    assert found.mean() == pytest.approx(1 - share, abs=0.04)
    towards = keypoints.pixels[found].mean(axis=0) - keypoints.pixels[~found].mean(axis=0)
    along = keypoints.pixels @ (towards / np.linalg.norm(towards))
    wrong_side = np.sum(along[found] < np.quantile(along, share))
    assert wrong_side <= 0.15 * found.sum()


def test_different_tests_are_hidden_from_different_sides(keypoints):
    masks = [remaining(keypoints, Disturbance(name="", hidden=0.4), test) for test in range(12)]
    assert sum(np.array(masks)).min() > 0


@pytest.mark.parametrize("disturbance", ROUGH, ids=lambda one: one.name)
def test_a_test_is_always_disturbed_alike_whatever_is_matched(keypoints, disturbance):
    rows, none = np.arange(MANY), np.zeros(MANY, bool)
    all_remain, all_pixels = disturbed(keypoints, rows, none, disturbance, 3)
    some_remain, some_pixels = disturbed(keypoints, rows[::7], none[::7], disturbance, 3)
    assert np.array_equal(all_remain[::7], some_remain)
    assert np.array_equal(all_pixels[::7], some_pixels)
    other, _ = disturbed(keypoints, rows, none, disturbance, 4)
    assert not np.array_equal(all_remain, other)


@pytest.mark.parametrize("disturbance", ROUGH, ids=lambda one: one.name)
def test_wrong_matches_do_not_disappear_as_right_ones_do(keypoints, disturbance):
    rows = np.arange(MANY)
    right, _ = disturbed(keypoints, rows, np.zeros(MANY, bool), disturbance, 0)
    wrong, _ = disturbed(keypoints, rows, np.ones(MANY, bool), disturbance, 0)
    assert np.all(wrong[right])
    assert right.mean() < wrong.mean() < 1


def test_without_a_disturbance_nothing_changes(keypoints):
    rows = np.arange(MANY)
    remain, pixels = disturbed(keypoints, rows, np.zeros(MANY, bool), Disturbance(name="none"), 0)
    assert remain.all()
    assert np.array_equal(pixels, keypoints.pixels)
