import numpy as np
import pycolmap
import pytest
from lenses import MODELS, distorted, matches

from scenes import BOX, camera, poses
from slimsfm.geometry import corner_error, project, rotation_error_deg
from slimsfm.pose import FocalPrior, Gravity, RansacOptions, estimate_pose, with_focal_length

DOWN = np.array([0.0, 0.0, -9.81])


def gravity_at(cam_from_world, tilt_deg=0.0, uncertainty_deg=2.0, seed=0):
    """Gravity as measured by an accelerometer with an error of this angle about a random horizontal axis."""
    in_cam = cam_from_world.rotation.matrix() @ DOWN
    axis = np.cross(in_cam, np.random.default_rng(seed).normal(size=3))
    turn = pycolmap.Rotation3d(np.radians(tilt_deg) * axis / np.linalg.norm(axis))
    return Gravity(in_world=DOWN, in_cam=turn.matrix() @ in_cam, uncertainty_deg=uncertainty_deg)


@pytest.mark.parametrize("model", MODELS)
def test_exact_pose_is_found_with_every_camera_model(model):
    lens = distorted(model)
    for cam_from_world in poses(3):
        pixels, points, _ = matches(lens, cam_from_world)
        found = estimate_pose(pixels, points, lens, gravity=gravity_at(cam_from_world))
        assert found.num_inliers == 100
        assert rotation_error_deg(found.cam_from_world, cam_from_world) < 1e-5
        assert corner_error(found.cam_from_world, cam_from_world, BOX) < 1e-6


@pytest.mark.parametrize("tilt_deg", [0.0, 2.0, 4.0])
@pytest.mark.parametrize("seed", range(3))
def test_pose_is_found_among_90_percent_outliers_with_inexact_gravity(seed, tilt_deg):
    truth = poses(7)[seed]
    pixels, points, wrong = matches(camera(), truth, 300, outliers=0.9, sigma_px=0.5, seed=seed)
    found = estimate_pose(pixels, points, camera(), gravity=gravity_at(truth, tilt_deg, seed=seed))
    assert corner_error(found.cam_from_world, truth, BOX) < 0.02
    assert found.inliers[~wrong].all()
    assert rotation_error_deg(found.cam_from_world, truth) < 1


@pytest.mark.parametrize("seed", range(3))
def test_pose_agrees_with_the_pose_without_gravity(seed):
    truth = poses(5)[seed]
    pixels, points, _ = matches(camera(), truth, 200, outliers=0.5, sigma_px=0.5, seed=seed)
    found = estimate_pose(pixels, points, camera(), gravity=gravity_at(truth, 1.0, seed=seed))
    known = estimate_pose(pixels, points, camera())
    assert corner_error(found.cam_from_world, known.cam_from_world, BOX) < 2e-3
    assert np.mean(found.inliers == known.inliers) > 0.98
    predicted = found.predicted_corner_error(BOX)
    assert predicted == pytest.approx(known.predicted_corner_error(BOX), rel=0.3)


def test_exact_gravity_improves_a_pose_from_poor_matches():
    with_gravity, without = [], []
    for seed in range(12):
        truth = poses(12)[seed]
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.2, 0.2, (15, 3))
        pixels = project(points, truth, camera()) + rng.normal(size=(15, 2))
        found = estimate_pose(pixels, points, camera(), gravity=gravity_at(truth, uncertainty_deg=0.1))
        with_gravity.append(rotation_error_deg(found.cam_from_world, truth))
        without.append(rotation_error_deg(estimate_pose(pixels, points, camera()).cam_from_world, truth))
    assert np.median(with_gravity) < 0.7 * np.median(without)


@pytest.mark.parametrize("tilt_deg", [30.0, 180.0])
def test_wrong_gravity_gives_no_pose(tilt_deg):
    pixels, points, _ = matches(camera(), poses(5)[0], 200, sigma_px=0.5)
    options = RansacOptions(max_iterations=500)
    wrong = gravity_at(poses(5)[0], tilt_deg)
    assert estimate_pose(pixels, points, camera(), options, gravity=wrong) is None


def test_points_on_a_plane_suffice():
    truth = poses(5)[1]
    pixels, points, _ = matches(camera(), truth, 200)
    points[:, 2] = 0
    pixels = project(points, truth, camera())
    pixels[:100] = np.random.default_rng(0).uniform((0, 0), (640, 480), (100, 2))
    found = estimate_pose(pixels, points, camera(), gravity=gravity_at(truth, 1.0))
    assert corner_error(found.cam_from_world, truth, BOX) < 1e-3
    assert found.inliers[100:].all()


def test_result_does_not_depend_on_the_length_of_gravity():
    truth = poses(5)[2]
    pixels, points, _ = matches(camera(), truth, sigma_px=0.5)
    measured = gravity_at(truth, 1.0)
    scaled = Gravity(in_world=1000 * measured.in_world, in_cam=measured.in_cam / 1000)
    one, two = (estimate_pose(pixels, points, camera(), gravity=g) for g in (measured, scaled))
    assert corner_error(one.cam_from_world, two.cam_from_world, BOX) < 1e-6


@pytest.mark.parametrize("down", np.vstack([np.eye(3), -np.eye(3)]), ids=str)
def test_gravity_may_have_any_direction(down):
    truth = poses(5)[3]
    pixels, points, _ = matches(camera(), truth)
    measured = Gravity(in_world=down, in_cam=truth.rotation.matrix() @ down)
    found = estimate_pose(pixels, points, camera(), gravity=measured)
    assert corner_error(found.cam_from_world, truth, BOX) < 1e-6


def test_result_is_deterministic():
    pixels, points, _ = matches(camera(), poses(5)[1], 200, outliers=0.8, sigma_px=1.0)
    measured = gravity_at(poses(5)[1], 1.0)
    one, two = (estimate_pose(pixels, points, camera(), gravity=measured) for _ in range(2))
    assert np.array_equal(one.cam_from_world.matrix(), two.cam_from_world.matrix())
    assert np.array_equal(one.inliers, two.inliers)
    assert np.array_equal(one.covariance, two.covariance)


@pytest.mark.parametrize("count", [0, 1, 3, 11])
def test_too_few_matches_give_no_pose(count):
    pixels, points, _ = matches(camera(), poses(5)[0])
    measured = gravity_at(poses(5)[0])
    assert estimate_pose(pixels[:count], points[:count], camera(), gravity=measured) is None


def test_outliers_only_give_no_pose():
    pixels, points, _ = matches(camera(), poses(5)[0], outliers=1.0)
    options = RansacOptions(max_iterations=1000)
    assert estimate_pose(pixels, points, camera(), options, gravity=gravity_at(poses(5)[0])) is None


def test_coinciding_points_give_no_pose():
    pixels, points, _ = matches(camera(), poses(5)[0])
    measured, options = gravity_at(poses(5)[0]), RansacOptions(max_iterations=200)
    assert estimate_pose(pixels, 0 * points, camera(), options, gravity=measured) is None


def test_pixels_outside_the_lens_are_not_inliers():
    lens = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 150.0, 640, 480)
    truth = poses(5)[0]
    pixels, points, _ = matches(lens, truth)
    pixels[:10] = (1e5, 1e5)
    found = estimate_pose(pixels, points, lens, gravity=gravity_at(truth))
    assert found.inliers.tolist() == [False] * 10 + [True] * 90


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"in_world": np.zeros(3)}, "in_world"),
        ({"in_cam": np.array([0.0, np.nan, 1.0])}, "in_cam"),
        ({"uncertainty_deg": 0.0}, "uncertainty_deg"),
        ({"uncertainty_deg": 90.0}, "uncertainty_deg"),
        ({"uncertainty_deg": float("nan")}, "uncertainty_deg"),
    ],
    ids=str,
)
def test_error_names_the_invalid_field_of_gravity(values, name):
    with pytest.raises(ValueError, match=name):
        Gravity(**{"in_world": DOWN, "in_cam": DOWN, **values})


def test_error_names_invalid_cameras_and_matches():
    pixels, points, _ = matches(camera(), poses(5)[0])
    measured = gravity_at(poses(5)[0])
    spherical = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 640, 480)
    with pytest.raises(ValueError, match="camera must have a focal length"):
        estimate_pose(pixels, points, spherical, gravity=measured)
    pixels[3, 0] = np.inf
    with pytest.raises(ValueError, match=r"points2D must be finite.* in row 3"):
        estimate_pose(pixels, points, camera(), gravity=measured)


def test_gravity_and_focal_length_are_used_together():
    truth = poses(5)[1]
    pixels, points, _ = matches(camera(), truth, 200, outliers=0.5, sigma_px=0.5)
    given = with_focal_length(camera(), 450.0)
    measured, focal = gravity_at(truth, uncertainty_deg=0.05), FocalPrior.of(given, 0.3)
    with_gravity = estimate_pose(pixels, points, given, gravity=measured, focal=focal)
    without = estimate_pose(pixels, points, given, focal=focal)
    assert with_gravity.camera.mean_focal_length() == pytest.approx(camera().mean_focal_length(), rel=0.05)
    errors = (rotation_error_deg(pose.cam_from_world, truth) for pose in (with_gravity, without))
    assert next(errors) < next(errors)
    wrong = gravity_at(truth, 30.0)
    assert estimate_pose(pixels, points, given, gravity=wrong, focal=focal) is None


@pytest.mark.parametrize("length", [1e-300, 1e-200, 1e300])
def test_the_lengths_of_the_directions_do_not_matter(length):
    down = np.array([0.0, 0.0, -1.0])
    pixels, points, _ = matches(camera(), poses(1)[0])
    in_cam = poses(1)[0].rotation.matrix() @ down
    gravity = Gravity(in_world=length * down, in_cam=length * in_cam)
    found = estimate_pose(pixels, points, camera(), gravity=gravity)
    assert corner_error(found.cam_from_world, poses(1)[0], BOX) < 1e-3
