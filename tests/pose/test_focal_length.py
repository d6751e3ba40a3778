from functools import partial

import lenses
import numpy as np
import pycolmap
import pytest
from lenses import MODELS, distorted

from scenes import BOX, camera, poses
from slimsfm.geometry import corner_error
from slimsfm.pose import FocalPrior, RansacOptions, estimate_pose, with_focal_length
from slimsfm.synthetic.scene import look_at

UNCERTAINTIES = [None, 0.3]


def near(index=0):
    """A pose near enough that perspective determines the focal length."""
    angle = 0.7 + 2 * index
    return look_at(np.array([2.4 * np.cos(angle), 2.4 * np.sin(angle), 1.0]), np.zeros(3))


matches = partial(lenses.matches, count=300)


def estimate(points2D, points3D, given, options=RansacOptions(), relative_uncertainty=None):
    return estimate_pose(points2D, points3D, given, options, focal=FocalPrior.of(given, relative_uncertainty))


def relative_error(found, lens):
    return found.camera.mean_focal_length() / lens.mean_focal_length() - 1


@pytest.mark.parametrize("relative_uncertainty", UNCERTAINTIES)
@pytest.mark.parametrize("model", MODELS)
def test_exact_focal_length_is_found_with_every_camera_model(model, relative_uncertainty):
    lens = distorted(model)
    pixels, points, _ = matches(lens, poses(3)[0])
    given = with_focal_length(lens, 420.0)
    found = estimate(pixels, points, given, relative_uncertainty=relative_uncertainty)
    assert abs(relative_error(found, lens)) < 1e-6
    assert corner_error(found.cam_from_world, poses(3)[0], BOX) < 1e-5
    assert found.inliers.all()
    assert found.camera.model_name == model


def test_without_a_prior_the_focal_length_of_the_given_camera_is_ignored():
    pixels, points, _ = matches(camera(), near(), outliers=0.3, sigma_px=0.5)
    one, two = (estimate(pixels, points, with_focal_length(camera(), focal)) for focal in (50.0, 5000.0))
    assert one.camera.params == pytest.approx(two.camera.params)


@pytest.mark.parametrize("relative_uncertainty", UNCERTAINTIES)
@pytest.mark.parametrize("seed", range(4))
def test_focal_length_is_found_among_60_percent_outliers(seed, relative_uncertainty):
    pixels, points, wrong = matches(camera(), near(seed), outliers=0.6, sigma_px=1.0, seed=seed)
    given = with_focal_length(camera(), 500 * (0.8, 0.9, 1.1, 1.25)[seed])
    found = estimate(pixels, points, given, relative_uncertainty=relative_uncertainty)
    known = estimate_pose(pixels, points, camera())
    assert abs(relative_error(found, camera())) < 0.02
    assert abs(relative_error(found, camera())) < 4 * found.relative_focal_sigma
    assert corner_error(found.cam_from_world, known.cam_from_world, BOX) < 0.015
    assert np.mean(found.inliers[~wrong]) > 0.98
    assert np.mean(found.inliers != known.inliers) < 0.02


@pytest.mark.parametrize("focal_px", [200.0, 350.0, 900.0, 2000.0])
def test_wide_and_long_lenses_are_found_without_a_prior(focal_px):
    lens = with_focal_length(camera("SIMPLE_PINHOLE"), focal_px)
    eye = np.array([0.8, 0.3, 0.5]) * max(focal_px / 200, 1.6)
    pixels, points, _ = matches(lens, look_at(eye, np.zeros(3)), outliers=0.5, sigma_px=0.3)
    found = estimate(pixels, points, lens)
    assert abs(np.log1p(relative_error(found, lens))) < 4 * found.relative_focal_sigma < 0.3
    assert found.num_inliers >= 0.95 * 150


@pytest.mark.parametrize("relative_uncertainty", UNCERTAINTIES)
def test_oblique_plane_determines_the_focal_length(relative_uncertainty):
    pixels, points, _ = matches(camera(), near(), outliers=0.5, sigma_px=0.5, flat=True)
    found = estimate(pixels, points, camera(), relative_uncertainty=relative_uncertainty)
    assert abs(relative_error(found, camera())) < min(0.03, 4 * found.relative_focal_sigma)


@pytest.mark.parametrize("error", [0.9, 1.0, 1.15])
def test_frontal_wall_keeps_the_expected_focal_length(error):
    frontal = look_at(np.array([0.01, 0.02, 3.0]), np.zeros(3))
    lens = camera("SIMPLE_PINHOLE")
    pixels, points, _ = matches(lens, frontal, outliers=0.3, sigma_px=1.0, flat=True)
    given = with_focal_length(lens, 500.0 * error)
    found = estimate(pixels, points, given, relative_uncertainty=0.3)
    assert found.camera.mean_focal_length() == pytest.approx(500 * error, rel=0.05)
    assert 0.1 < found.relative_focal_sigma < 0.3
    assert found.num_inliers >= 200


def test_covariance_includes_the_error_caused_by_the_focal_length():
    ratios = []
    for seed in range(6):
        pixels, points, _ = matches(camera(), near(seed), outliers=0.3, sigma_px=1.0, seed=seed)
        found = estimate(pixels, points, camera())
        error = corner_error(found.cam_from_world, near(seed), BOX)
        ratios.append(error / found.predicted_corner_error(BOX))
        assert found.covariance.shape == (6, 6)
    assert 0.2 < np.median(ratios) < 2


def test_focal_length_stays_within_its_limits():
    pixels, points, _ = matches(camera(), near(), sigma_px=0.5)
    given = with_focal_length(camera(), 900.0)
    options = RansacOptions(max_error_px=20.0)
    found = estimate(pixels, points, given, options, relative_uncertainty=0.1)
    assert found.camera.mean_focal_length() >= 900 * 0.9 * (1 - 1e-9)


def test_two_focal_lengths_keep_their_ratio_and_other_parameters_are_unchanged():
    pixels, points, _ = matches(camera(), near())
    found = estimate(pixels, points, with_focal_length(camera(), 450.0))
    assert found.camera.params == pytest.approx(camera().params, rel=1e-5)
    assert (found.camera.width, found.camera.height) == (640, 480)


def test_result_is_deterministic_and_the_given_camera_is_unchanged():
    pixels, points, _ = matches(camera(), near(), outliers=0.6, sigma_px=1.0)
    given = camera()
    one, two = (estimate(pixels, points, given) for _ in range(2))
    assert np.array_equal(one.cam_from_world.matrix(), two.cam_from_world.matrix())
    assert np.array_equal(one.inliers, two.inliers)
    assert np.array_equal(one.camera.params, two.camera.params)
    assert np.array_equal(given.params, camera().params)


@pytest.mark.parametrize("count", [0, 3, 11])
def test_too_few_matches_give_no_pose(count):
    pixels, points, _ = matches(camera(), near())
    assert estimate(pixels[:count], points[:count], camera()) is None


def test_outliers_only_give_no_pose():
    pixels, points, _ = matches(camera(), near(), count=100, outliers=1.0)
    assert estimate(pixels, points, camera(), RansacOptions(max_iterations=1000)) is None


def test_pixels_outside_the_lens_are_not_inliers():
    lens = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 150.0, 640, 480)
    pixels, points, _ = matches(lens, near())
    pixels[:10] = (1e5, 1e5)
    found = estimate(pixels, points, lens, relative_uncertainty=0.3)
    assert found.inliers.tolist() == [False] * 10 + [True] * 290
    assert abs(relative_error(found, lens)) < 1e-6


@pytest.mark.parametrize("relative_uncertainty", [0.0, -0.1, 1.0, np.nan])
def test_error_names_an_invalid_uncertainty(relative_uncertainty):
    pixels, points, _ = matches(camera(), near())
    with pytest.raises(ValueError, match="relative_uncertainty must be between 0 and 1"):
        estimate(pixels, points, camera(), relative_uncertainty=float(relative_uncertainty))


def test_error_names_an_invalid_camera():
    seen = matches(camera(), near())[:2]
    with pytest.raises(ValueError, match="spherical model EQUIRECTANGULAR"):
        estimate(*seen, pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 640, 480))
    with pytest.raises(ValueError, match="camera must have a positive focal length"):
        estimate(*seen, pycolmap.Camera.create_from_model_name(1, "PINHOLE", -1.0, 640, 480))
    with pytest.raises(ValueError, match="camera must have the size of the image"):
        estimate(*seen, pycolmap.Camera(model="SIMPLE_PINHOLE", params=[500.0, 320.0, 240.0]))


def test_error_names_invalid_matches():
    pixels, points, _ = matches(camera(), near())
    pixels[3, 0] = np.inf
    with pytest.raises(ValueError, match=r"points2D must be finite.* in row 3"):
        estimate(pixels, points, camera())
    pixels[3, 0], points[17, 1] = 0, np.nan
    with pytest.raises(ValueError, match=r"points3D_in_world must be finite.* in row 17"):
        estimate(pixels, points, camera())
