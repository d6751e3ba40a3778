from functools import partial

import lenses
import numpy as np
import pytest

from scenes import BOX, camera
from slimsfm.geometry import corner_error
from slimsfm.pose import estimate_pose, with_focal_length
from slimsfm.pose.camera_fit import (
    ASPECT_RATIO,
    FOCAL_LENGTH,
    PRINCIPAL_POINT,
    check_camera,
    fit_camera,
    misfit,
    with_check,
)
from slimsfm.pose.priors import FramePrior, with_two_focal_lengths
from slimsfm.pose.types import bound_95, probability_below
from slimsfm.synthetic.scene import look_at

LENS = camera("SIMPLE_RADIAL")
matches = partial(lenses.matches, count=200)


def seen_from(index, distance=2.4):
    angle = 0.7 + 2 * index
    return look_at(distance * np.array([np.cos(angle), np.sin(angle), 0.4]), np.zeros(3))


def fitted(pixels, points, given):
    return fit_camera(pixels, points, estimate_pose(pixels, points, given), given)


@pytest.mark.parametrize("index", range(6))
def test_a_right_camera_is_kept_with_its_pose(index):
    pixels, points, _ = matches(LENS, seen_from(index), outliers=0.4, sigma_px=1.0, seed=index)
    before = estimate_pose(pixels, points, LENS)
    after = fit_camera(pixels, points, before, LENS)
    assert (after.camera, after.estimated) == (None, ())
    assert after.cam_from_world is before.cam_from_world
    assert misfit(after.check) < 1


@pytest.mark.parametrize("factor", [0.5, 0.77, 0.9, 1.1, 1.3, 2.0])
@pytest.mark.parametrize("index", range(2))
def test_a_wrong_focal_length_is_noticed_and_estimated(factor, index):
    pixels, points, _ = matches(LENS, seen_from(index), outliers=0.4, sigma_px=1.0, seed=index)
    given = with_focal_length(LENS, factor * LENS.mean_focal_length())
    wrong, found = estimate_pose(pixels, points, given), fitted(pixels, points, given)
    assert found.estimated == (FOCAL_LENGTH,)
    assert found.camera.mean_focal_length() == pytest.approx(LENS.mean_focal_length(), rel=0.02)
    assert corner_error(found.cam_from_world, seen_from(index), BOX) < 0.01
    assert corner_error(wrong.cam_from_world, seen_from(index), BOX) > 0.05
    assert found.num_inliers >= wrong.num_inliers


@pytest.mark.parametrize("index", range(3))
def test_the_principal_point_of_a_crop_is_estimated(index):
    pixels, points, _ = matches(LENS, seen_from(index), outliers=0.4, sigma_px=1.0, seed=index)
    found = fitted(pixels + np.array([100.0, 80.0]), points, LENS)
    assert found.estimated == (FOCAL_LENGTH, PRINCIPAL_POINT)
    center = LENS.params[LENS.principal_point_idxs()] + (100.0, 80.0)
    assert found.camera.params[found.camera.principal_point_idxs()] == pytest.approx(center, abs=12)
    assert corner_error(found.cam_from_world, seen_from(index), BOX) < 0.02


def test_stretched_pixels_are_estimated():
    pixels, points, _ = matches(LENS, seen_from(0), outliers=0.4, sigma_px=1.0)
    center = LENS.params[LENS.principal_point_idxs()]
    found = fitted(center + (pixels - center) * (1.0, 0.8), points, LENS)
    assert ASPECT_RATIO in found.estimated
    x_px, y_px = found.camera.params[found.camera.focal_length_idxs()]
    assert y_px / x_px == pytest.approx(0.8, rel=0.02)
    assert corner_error(found.cam_from_world, seen_from(0), BOX) < 0.02


@pytest.mark.parametrize("model", lenses.MODELS)
def test_every_camera_model_can_be_checked_and_corrected(model):
    lens = lenses.distorted(model)
    pixels, points, _ = matches(lens, seen_from(0), sigma_px=0.5)
    assert fitted(pixels, points, lens).estimated == ()
    found = fitted(pixels, points, with_focal_length(lens, 1.2 * lens.mean_focal_length()))
    assert found.estimated[:1] == (FOCAL_LENGTH,)
    assert corner_error(found.cam_from_world, seen_from(0), BOX) < 0.02


def test_a_check_alone_keeps_the_pose():
    pixels, points, _ = matches(LENS, seen_from(0), sigma_px=1.0)
    given = with_focal_length(LENS, 1.2 * LENS.mean_focal_length())
    before = estimate_pose(pixels, points, given)
    after = with_check(pixels, points, before, given)
    assert after.cam_from_world is before.cam_from_world
    assert misfit(after.check) > 1


def test_what_the_intrinsics_could_change_grows_with_the_distance():
    lengths = []
    for distance in (2.4, 5.0, 10.0):
        lens = with_focal_length(LENS, 500.0 * distance / 2.4)
        pixels, points, _ = matches(lens, seen_from(0, distance), sigma_px=1.0)
        check = check_camera(pixels, points, seen_from(0, distance), lens)
        lengths.append(np.sqrt(np.trace(check.growth[3:, 3:])))
    assert lengths == sorted(lengths)
    assert lengths[-1] > 10 * lengths[0]


@pytest.mark.parametrize("model", lenses.MODELS)
def test_a_camera_with_two_focal_lengths_is_equal(model):
    lens = lenses.distorted(model)
    two = with_two_focal_lengths(lens)
    rays = np.column_stack([np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2)), np.ones(50)])
    if two is not None:
        assert np.allclose(two.img_from_cam(rays), lens.img_from_cam(rays))
        assert len(two.focal_length_idxs()) == 2
        expected = FramePrior(camera=lens, center=True, aspect=True)
        assert np.allclose(expected.rows(seen_from(0, 2.4), two).residuals, 0)


@pytest.mark.parametrize("seed", range(6))
def test_a_bound_holds_in_95_percent(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4)) * rng.uniform(0.01, 2, 4)
    lengths = np.linalg.norm(rng.normal(size=(100_000, 4)) @ root.T, axis=1)
    assert np.mean(lengths < bound_95(root @ root.T)) == pytest.approx(0.95, abs=0.006)
    for length in np.quantile(lengths, (0.5, 0.8, 0.99)):
        assert probability_below(length, root @ root.T) == pytest.approx(np.mean(lengths < length), abs=0.04)
    assert probability_below(bound_95(root @ root.T), root @ root.T) == pytest.approx(0.95, abs=1e-4)
    assert probability_below(1.0, np.zeros((3, 3))) == 1
