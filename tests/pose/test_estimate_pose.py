import cv2
import numpy as np
import pycolmap
import pytest
from lenses import MODELS, distorted, matches

from scenes import BOX, camera, poses
from slimsfm.geometry import corner_error, reprojection_errors, rotation_error_deg
from slimsfm.pose import RansacOptions, estimate_pose


@pytest.mark.parametrize("model", MODELS)
def test_exact_pose_is_found_with_every_camera_model(model):
    lens = distorted(model)
    for cam_from_world in poses(3):
        pixels, points, _ = matches(lens, cam_from_world)
        assert np.isfinite(pixels).all()
        found = estimate_pose(pixels, points, lens)
        assert found.num_inliers == 100
        assert rotation_error_deg(found.cam_from_world, cam_from_world) < 1e-6
        assert corner_error(found.cam_from_world, cam_from_world, BOX) < 1e-6


def test_spherical_camera_is_rejected():
    lens = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 640, 480)
    pixels, points, _ = matches(camera(), poses(1)[0])
    with pytest.raises(ValueError, match="spherical model EQUIRECTANGULAR"):
        estimate_pose(pixels, points, lens)


@pytest.mark.parametrize("seed", range(5))
def test_pose_is_found_among_50_percent_outliers(seed):
    pixels, points, wrong = matches(camera(), poses(7)[seed], 200, outliers=0.5, sigma_px=0.5, seed=seed)
    found = estimate_pose(pixels, points, camera())
    errors = reprojection_errors(pixels, points, poses(7)[seed], camera())
    assert corner_error(found.cam_from_world, poses(7)[seed], BOX) < 5e-3
    assert found.inliers[~wrong].all()
    assert (errors[found.inliers] < 7).all()


@pytest.mark.parametrize("seed", range(3))
def test_pose_agrees_with_pycolmap_and_opencv(seed):
    truth = poses(5)[seed]
    lens = camera()
    pixels, points, _ = matches(lens, truth, 200, outliers=0.3, sigma_px=0.5, seed=seed)
    ours = estimate_pose(pixels, points, lens)
    theirs = pycolmap.estimate_and_refine_absolute_pose(
        pixels, points, lens, estimation_options={"ransac": {"max_error": 6.0}}
    )
    assert corner_error(ours.cam_from_world, theirs["cam_from_world"], BOX) < 1e-3
    assert np.mean(ours.inliers == theirs["inlier_mask"]) > 0.98
    fx, fy, cx, cy = lens.params[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    found, rotation, translation, _ = cv2.solvePnPRansac(
        points, pixels, matrix, lens.params[4:], reprojectionError=6.0, iterationsCount=1000
    )
    opencv = pycolmap.Rigid3d(pycolmap.Rotation3d(cv2.Rodrigues(rotation)[0]), translation[:, 0])
    assert found
    assert corner_error(ours.cam_from_world, opencv, BOX) < 5e-3


def test_result_is_deterministic_and_nearly_independent_of_match_order():
    pixels, points, _ = matches(camera(), poses(5)[1], 200, outliers=0.5, sigma_px=1.0)
    one, two = (estimate_pose(pixels, points, camera()) for _ in range(2))
    assert np.array_equal(one.cam_from_world.matrix(), two.cam_from_world.matrix())
    assert np.array_equal(one.inliers, two.inliers)
    order = np.random.default_rng(1).permutation(200)
    other = estimate_pose(pixels[order], points[order], camera())
    assert corner_error(one.cam_from_world, other.cam_from_world, BOX) < 1e-3


def test_result_scales_with_the_unit_of_the_map():
    pixels, points, _ = matches(camera(), poses(5)[2], sigma_px=0.5)
    one, thousand = (estimate_pose(pixels, scale * points, camera()) for scale in (1, 1000))
    assert thousand.cam_from_world.translation == pytest.approx(
        1000 * one.cam_from_world.translation, rel=1e-4
    )


@pytest.mark.parametrize("count", [0, 3, 11])
def test_too_few_matches_give_no_pose(count):
    pixels, points, _ = matches(camera(), poses(5)[0])
    assert estimate_pose(pixels[:count], points[:count], camera()) is None


def test_outliers_only_give_no_pose():
    pixels, points, _ = matches(camera(), poses(5)[0], outliers=1.0)
    assert estimate_pose(pixels, points, camera(), RansacOptions(max_iterations=500)) is None


def test_pixels_outside_the_lens_are_not_inliers():
    lens = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 150.0, 640, 480)
    truth = poses(5)[0]
    pixels, points, _ = matches(lens, truth)
    pixels[:10] = (1e5, 1e5)
    found = estimate_pose(pixels, points, lens)
    assert found.inliers.tolist() == [False] * 10 + [True] * 90
    assert corner_error(found.cam_from_world, truth, BOX) < 1e-6


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_error_names_the_row_of_a_non_finite_coordinate(bad):
    pixels, points, _ = matches(camera(), poses(5)[0])
    points[17, 1] = bad
    with pytest.raises(ValueError, match=r"points3D_in_world must be finite.* in row 17"):
        estimate_pose(pixels, points, camera())
    points[17, 1], pixels[3, 0] = 0, bad
    with pytest.raises(ValueError, match=r"points2D must be finite.* in row 3"):
        estimate_pose(pixels, points, camera())


@pytest.mark.parametrize(
    "values",
    [{"max_error_px": 0.0}, {"max_error_px": float("nan")}, {"min_inliers": 3}, {"max_iterations": 0}],
    ids=str,
)
def test_error_names_the_invalid_option(values):
    with pytest.raises(ValueError, match=next(iter(values))):
        RansacOptions(**values)
