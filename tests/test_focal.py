from functools import partial

import numpy as np
import pycolmap
import pytest

from scenes import BOX, camera, poses
from slimsfm.focal import estimate_pose_and_focal
from slimsfm.geometry import corner_error, project
from slimsfm.pose import RansacOptions, estimate_pose
from slimsfm.refinement import with_focal_length
from slimsfm.synthetic.trajectory import look_at
from test_pose import MODELS, distorted

UNCERTAINTIES = [None, 0.3]


def near(index=0):
    """A pose near enough that perspective tells the focal length."""
    angle = 0.7 + 2 * index
    return look_at(np.array([2.4 * np.cos(angle), 2.4 * np.sin(angle), 1.0]), np.zeros(3))


def matches(lens, cam_from_world, count=300, outliers=0.0, sigma_px=0.0, seed=0, flat=False):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) @ BOX.half_edges
    if flat:
        points[:, 2] = 0
    pixels = project(points, cam_from_world, lens) + sigma_px * rng.normal(size=(count, 2))
    wrong = rng.permutation(count) < outliers * count
    pixels[wrong] = rng.uniform((0, 0), (640, 480), (int(wrong.sum()), 2))
    return pixels, points, wrong


def relative_error(found, lens):
    return found.camera.mean_focal_length() / lens.mean_focal_length() - 1


@pytest.mark.parametrize("relative_uncertainty", UNCERTAINTIES)
@pytest.mark.parametrize("model", MODELS)
def test_an_exact_focal_length_is_found_through_every_lens(model, relative_uncertainty):
    lens = distorted(model)
    pixels, points, _ = matches(lens, poses(3)[0])
    given = with_focal_length(lens, 420.0)
    found = estimate_pose_and_focal(pixels, points, given, relative_uncertainty=relative_uncertainty)
    assert abs(relative_error(found, lens)) < 1e-6
    assert corner_error(found.pose.cam_from_world, poses(3)[0], BOX) < 1e-5
    assert found.pose.inliers.all()
    assert found.camera.model_name == model


def test_without_an_expectation_the_focal_length_of_the_given_camera_does_not_count():
    pixels, points, _ = matches(camera(), near(), outliers=0.3, sigma_px=0.5)
    one, two = (
        estimate_pose_and_focal(pixels, points, with_focal_length(camera(), focal))
        for focal in (50.0, 5000.0)
    )
    assert one.camera.params == pytest.approx(two.camera.params)


@pytest.mark.parametrize("relative_uncertainty", UNCERTAINTIES)
@pytest.mark.parametrize("seed", range(4))
def test_most_of_the_matches_may_be_wrong(seed, relative_uncertainty):
    pixels, points, wrong = matches(camera(), near(seed), outliers=0.6, sigma_px=1.0, seed=seed)
    given = with_focal_length(camera(), 500 * (0.8, 0.9, 1.1, 1.25)[seed])
    found = estimate_pose_and_focal(pixels, points, given, relative_uncertainty=relative_uncertainty)
    known = estimate_pose(pixels, points, camera())
    assert abs(relative_error(found, camera())) < 0.02
    assert abs(relative_error(found, camera())) < 4 * found.relative_sigma
    assert corner_error(found.pose.cam_from_world, known.cam_from_world, BOX) < 0.015
    assert np.mean(found.pose.inliers[~wrong]) > 0.98
    assert np.mean(found.pose.inliers != known.inliers) < 0.02


@pytest.mark.parametrize("focal_px", [200.0, 350.0, 900.0, 2000.0])
def test_wide_and_long_lenses_are_found_without_any_expectation(focal_px):
    lens = with_focal_length(camera("SIMPLE_PINHOLE"), focal_px)
    eye = np.array([0.8, 0.3, 0.5]) * max(focal_px / 200, 1.6)
    pixels, points, _ = matches(lens, look_at(eye, np.zeros(3)), outliers=0.5, sigma_px=0.3)
    found = estimate_pose_and_focal(pixels, points, lens)
    assert abs(np.log1p(relative_error(found, lens))) < 4 * found.relative_sigma < 0.3
    assert found.pose.num_inliers >= 0.95 * 150


@pytest.mark.parametrize("relative_uncertainty", UNCERTAINTIES)
def test_a_plane_seen_aslant_tells_the_focal_length(relative_uncertainty):
    pixels, points, _ = matches(camera(), near(), outliers=0.5, sigma_px=0.5, flat=True)
    found = estimate_pose_and_focal(pixels, points, camera(), relative_uncertainty=relative_uncertainty)
    assert abs(relative_error(found, camera())) < min(0.03, 4 * found.relative_sigma)


@pytest.mark.parametrize("error", [0.9, 1.0, 1.15])
def test_a_wall_seen_from_the_front_leaves_the_focal_length_where_it_was_expected(error):
    frontal = look_at(np.array([0.01, 0.02, 3.0]), np.zeros(3))
    lens = camera("SIMPLE_PINHOLE")
    pixels, points, _ = matches(lens, frontal, outliers=0.3, sigma_px=1.0, flat=True)
    given = with_focal_length(lens, 500.0 * error)
    found = estimate_pose_and_focal(pixels, points, given, relative_uncertainty=0.3)
    assert found.camera.mean_focal_length() == pytest.approx(500 * error, rel=0.05)
    assert 0.1 < found.relative_sigma < 0.3
    assert found.pose.num_inliers >= 200


def test_the_covariance_covers_the_error_that_the_focal_length_brings():
    ratios = []
    for seed in range(6):
        pixels, points, _ = matches(camera(), near(seed), outliers=0.3, sigma_px=1.0, seed=seed)
        found = estimate_pose_and_focal(pixels, points, camera())
        error = corner_error(found.pose.cam_from_world, near(seed), BOX)
        ratios.append(error / found.pose.predicted_corner_error(BOX))
        assert found.pose.covariance.shape == (6, 6)
    assert 0.2 < np.median(ratios) < 2


def test_the_focal_length_stays_within_its_uncertainty():
    pixels, points, _ = matches(camera(), near(), sigma_px=0.5)
    given = with_focal_length(camera(), 900.0)
    options = RansacOptions(max_error_px=20.0)
    found = estimate_pose_and_focal(pixels, points, given, options, relative_uncertainty=0.1)
    assert found.camera.mean_focal_length() >= 900 * 0.9 * (1 - 1e-9)


def test_two_focal_lengths_keep_their_ratio_and_the_rest_of_the_camera_stays():
    pixels, points, _ = matches(camera(), near())
    found = estimate_pose_and_focal(pixels, points, with_focal_length(camera(), 450.0))
    assert found.camera.params == pytest.approx(camera().params, rel=1e-5)
    assert (found.camera.width, found.camera.height) == (640, 480)


def test_equal_input_gives_equal_output_and_leaves_the_camera_alone():
    pixels, points, _ = matches(camera(), near(), outliers=0.6, sigma_px=1.0)
    given = camera()
    one, two = (estimate_pose_and_focal(pixels, points, given) for _ in range(2))
    assert np.array_equal(one.pose.cam_from_world.matrix(), two.pose.cam_from_world.matrix())
    assert np.array_equal(one.pose.inliers, two.pose.inliers)
    assert np.array_equal(one.camera.params, two.camera.params)
    assert np.array_equal(given.params, camera().params)


@pytest.mark.parametrize("count", [0, 3, 11])
def test_too_few_matches_give_no_pose(count):
    pixels, points, _ = matches(camera(), near())
    assert estimate_pose_and_focal(pixels[:count], points[:count], camera()) is None


def test_nothing_but_wrong_matches_give_no_pose():
    pixels, points, _ = matches(camera(), near(), 100, outliers=1.0)
    assert estimate_pose_and_focal(pixels, points, camera(), RansacOptions(max_iterations=1000)) is None


def test_pixels_that_no_ray_reaches_are_no_inliers():
    lens = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 150.0, 640, 480)
    pixels, points, _ = matches(lens, near())
    pixels[:10] = (1e5, 1e5)
    found = estimate_pose_and_focal(pixels, points, lens, relative_uncertainty=0.3)
    assert found.pose.inliers.tolist() == [False] * 10 + [True] * 290
    assert abs(relative_error(found, lens)) < 1e-6


@pytest.mark.parametrize("relative_uncertainty", [0.0, -0.1, 1.0, np.nan])
def test_an_uncertainty_that_is_none_is_named(relative_uncertainty):
    pixels, points, _ = matches(camera(), near())
    with pytest.raises(ValueError, match="relative_uncertainty must be between 0 and 1"):
        estimate_pose_and_focal(pixels, points, camera(), relative_uncertainty=float(relative_uncertainty))


def test_cameras_that_cannot_serve_are_named():
    estimate = partial(estimate_pose_and_focal, *matches(camera(), near())[:2])
    with pytest.raises(ValueError, match="spherical model EQUIRECTANGULAR"):
        estimate(pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 640, 480))
    with pytest.raises(ValueError, match="camera must have a positive focal length"):
        estimate(pycolmap.Camera.create_from_model_name(1, "PINHOLE", -1.0, 640, 480))
    with pytest.raises(ValueError, match="camera must have the size of the image"):
        estimate(pycolmap.Camera(model="SIMPLE_PINHOLE", params=[500.0, 320.0, 240.0]))


def test_matches_that_cannot_serve_are_named():
    pixels, points, _ = matches(camera(), near())
    pixels[3, 0] = np.inf
    with pytest.raises(ValueError, match=r"points2D must be finite.* in row 3"):
        estimate_pose_and_focal(pixels, points, camera())
    pixels[3, 0], points[17, 1] = 0, np.nan
    with pytest.raises(ValueError, match=r"points3D_in_world must be finite.* in row 17"):
        estimate_pose_and_focal(pixels, points, camera())
