import numpy as np
import pycolmap
import pytest
from lenses import MODELS, distorted, matches

from scenes import BOX, camera, poses
from slimsfm.geometry import corner_error, motions, project
from slimsfm.pose import (
    FocalPrior,
    Gravity,
    PoseEstimate,
    estimate_pose,
    projection_jacobian,
    refine_pose,
    rms_corner_errors,
    with_focal_length,
)

ANY_FOCAL = FocalPrior(expected_px=510.0, log_sigma=1e6, limits_px=(1.0, 1e6), tried_px=np.array([510.0]))


def nudged(cam_from_world, turn=(0.01, -0.02, 0.01), shift=(0.02, 0.01, -0.05)):
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(turn)), np.array(shift)) * cam_from_world


def gravity_at(cam_from_world, down=(0.0, 0.0, -1.0), uncertainty_deg=2.0):
    in_world = np.array(down)
    in_cam = cam_from_world.rotation.matrix() @ in_world
    return Gravity(in_world=in_world, in_cam=in_cam, uncertainty_deg=uncertainty_deg)


@pytest.mark.parametrize("prior", ["none", "focal", "gravity", "both"])
@pytest.mark.parametrize("model", MODELS)
def test_exact_matches_lead_back_to_the_pose_with_every_camera_model(model, prior):
    lens, truth = distorted(model), poses(3)[0]
    pixels, points, _ = matches(lens, truth)
    free_focal = prior in ("focal", "both")
    start = with_focal_length(lens, 510.0) if free_focal else lens
    found = refine_pose(
        pixels,
        points,
        nudged(truth),
        start,
        max_error_px=60.0,
        focal=ANY_FOCAL if free_focal else None,
        gravity=gravity_at(truth) if prior in ("gravity", "both") else None,
    )
    assert corner_error(found.cam_from_world, truth, BOX) < 1e-5
    assert found.inliers.all()
    assert (found.camera is not None) == (found.relative_focal_sigma is not None) == free_focal
    if free_focal:
        assert found.camera.mean_focal_length() == pytest.approx(lens.mean_focal_length(), rel=1e-6)


def test_a_free_focal_length_increases_the_variance_of_the_pose():
    pixels, points, _ = matches(camera(), poses(3)[0], sigma_px=0.5)
    fixed, free = (
        refine_pose(
            pixels,
            points,
            poses(3)[0],
            camera(),
            max_error_px=6.0,
            gravity=gravity_at(poses(3)[0]),
            focal=focal,
        )
        for focal in (None, ANY_FOCAL)
    )
    assert free.relative_focal_sigma > 0
    assert np.all(np.diag(free.covariance) > 0.99 * np.diag(fixed.covariance))


def test_covariance_with_a_weak_prior_is_that_of_the_pose_without():
    pixels, points, _ = matches(camera(), poses(3)[0], sigma_px=1.0, count=300)
    known = estimate_pose(pixels, points, camera())
    weak = gravity_at(poses(3)[0], uncertainty_deg=45.0)
    for gravity in (None, weak):
        found = refine_pose(pixels, points, known.cam_from_world, camera(), max_error_px=6.0, gravity=gravity)
        ratio = np.diag(found.covariance) / np.diag(known.covariance)
        assert np.all((ratio > 0.5) & (ratio < 2))


def test_prior_decides_where_the_matches_leave_a_motion_free():
    truth = poses(3)[0]
    pixels, points, _ = matches(camera(), truth)
    line = np.outer(points[:, 0], (1.0, 0.2, 0.1))  # the pose can turn about it
    pixels = np.asarray(camera().img_from_cam(truth * line))
    gravity = gravity_at(truth, uncertainty_deg=0.5)
    found = refine_pose(pixels, line, nudged(truth), camera(), max_error_px=60.0, gravity=gravity)
    assert corner_error(found.cam_from_world, truth, BOX) < 1e-3


def test_derivative_of_gravity_agrees_with_finite_differences():
    pose, step = poses(3)[1], 1e-6
    measured = Gravity(in_world=np.array([0.1, 0.2, -1.0]), in_cam=np.array([0.3, 1.0, 0.2]))
    at = measured.rows(pose, camera())
    for axis in range(3):
        ahead, behind = (
            measured.rows(nudged(pose, sign * step * np.eye(3)[axis], np.zeros(3)), camera()).residuals
            for sign in (1, -1)
        )
        assert (ahead - behind) / (2 * step) == pytest.approx(at.jacobian[:, axis], abs=1e-5)
    assert np.all(at.jacobian[:, 3:] == 0)


def test_projection_jacobian_agrees_with_finite_differences():
    pose, step = poses(3)[1], 1e-6
    points = matches(camera(), pose)[1]
    lens = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[500.0, 320.0, 240.0])
    jacobian = projection_jacobian(pose * points, 500.0)
    for axis in range(6):
        offset = step * np.eye(6)[axis]
        ahead, behind = (
            project(points, nudged(pose, sign * offset[:3], sign * offset[3:]), lens) for sign in (1, -1)
        )
        assert (ahead - behind) / (2 * step) == pytest.approx(jacobian[:, :, axis], abs=1e-4)


@pytest.mark.parametrize("with_gravity", [False, True])
def test_matches_that_agree_with_no_pose_give_no_covariance(with_gravity):
    pixels, points, _ = matches(camera(), poses(3)[0])
    gravity = gravity_at(poses(3)[0]) if with_gravity else None
    wrong = np.random.default_rng(0).uniform(0, 480, pixels.shape)
    found = refine_pose(wrong, points, poses(3)[0], camera(), max_error_px=0.1, gravity=gravity)
    assert found.num_inliers < 4
    assert found.covariance is None
    with pytest.raises(ValueError, match="covariance must not be None"):
        found.predicted_corner_error(BOX)


def test_predicted_corner_error_is_that_of_sampled_poses():
    rng = np.random.default_rng(0)
    sigmas = np.diag([0.01, 0.02, 0.01, 0.05, 0.02, 0.03])
    pose = PoseEstimate(cam_from_world=poses(3)[0], inliers=np.ones(4, bool), covariance=sigmas @ sigmas)
    steps = 0.1 * rng.normal(size=(4000, 6)) @ sigmas
    moved = np.array([nudged(poses(3)[0], step[:3], step[3:]) * BOX.corners for step in steps])
    squares = np.sum((moved - poses(3)[0] * BOX.corners) ** 2, axis=2).mean(axis=0)
    sampled = 10 * np.sqrt(squares).mean() / BOX.diagonal
    assert pose.predicted_corner_error(BOX) == pytest.approx(sampled, rel=0.03)


def test_rms_corner_error_bounds_the_predicted_corner_error():
    rng = np.random.default_rng(1)
    for cam_from_world in poses(5):
        half = rng.normal(size=(6, 6)) * 0.01
        pose = PoseEstimate(cam_from_world=cam_from_world, inliers=np.ones(4, bool), covariance=half @ half.T)
        corner_motions = motions(cam_from_world * BOX.corners).reshape(1, 24, 6) / BOX.diagonal
        (rms,) = rms_corner_errors(pose.covariance[None], corner_motions.astype(np.float32))
        assert pose.predicted_corner_error(BOX) <= rms * (1 + 1e-6)
        assert pose.predicted_corner_error(BOX) > 0.8 * rms


def test_with_focal_length_keeps_the_ratio_and_leaves_the_given_camera_unchanged():
    given = camera()
    changed = with_focal_length(given, 1005.0)
    assert changed.params == pytest.approx([1000, 1010, *camera().params[2:]])
    assert np.array_equal(given.params, camera().params)
