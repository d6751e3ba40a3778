import numpy as np
import pycolmap
import pytest

from scenes import BOX, camera, poses
from slimsfm.geometry import corner_error
from slimsfm.gravity import Gravity
from slimsfm.pose import estimate_pose
from slimsfm.refinement import PriorRows, refine, with_focal_length
from test_pose import MODELS, distorted, matches


def nudged(cam_from_world, turn=(0.01, -0.02, 0.01), shift=(0.02, 0.01, -0.05)):
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(turn)), np.array(shift)) * cam_from_world


@pytest.mark.parametrize("free_focal", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_exact_matches_lead_back_to_the_pose_through_every_lens(model, free_focal):
    lens, truth = distorted(model), poses(3)[0]
    pixels, points, _ = matches(lens, truth)
    start = with_focal_length(lens, 510.0) if free_focal else lens
    found = refine(pixels, points, nudged(truth), start, max_error_px=60.0, free_focal=free_focal)
    assert corner_error(found.cam_from_world, truth, BOX) < 1e-5
    assert found.camera.mean_focal_length() == pytest.approx(lens.mean_focal_length(), rel=1e-6)
    assert found.inliers.all()


def test_a_fixed_focal_length_has_no_variance_and_a_free_one_adds_to_that_of_the_pose():
    pixels, points, _ = matches(camera(), poses(3)[0], sigma_px=0.5)
    fixed, free = (
        refine(pixels, points, poses(3)[0], camera(), max_error_px=6.0, free_focal=f) for f in (False, True)
    )
    assert np.all(fixed.covariance[6] == 0)
    assert free.covariance[6, 6] > 0
    assert np.all(np.diag(free.covariance)[:6] > 0.99 * np.diag(fixed.covariance)[:6])


def test_the_covariance_is_that_of_the_pose_where_there_is_no_prior():
    pixels, points, _ = matches(camera(), poses(3)[0], sigma_px=1.0, count=300)
    known = estimate_pose(pixels, points, camera())
    found = refine(pixels, points, known.cam_from_world, camera(), max_error_px=6.0)
    ratio = np.diag(found.covariance)[:6] / np.diag(known.covariance)
    assert np.all((ratio > 0.5) & (ratio < 2))


def test_a_prior_decides_where_the_matches_leave_a_motion_free():
    truth = poses(3)[0]
    pixels, points, _ = matches(camera(), truth)
    line = np.outer(points[:, 0], (1.0, 0.2, 0.1))  # the pose can turn about it
    pixels = np.asarray(camera().img_from_cam(truth * line))
    down = np.array([0.0, 0.0, -1.0])
    told = Gravity(in_world=down, in_cam=truth.rotation.matrix() @ down, uncertainty_deg=0.5)
    found = refine(pixels, line, nudged(truth), camera(), max_error_px=60.0, priors=(told,))
    assert corner_error(found.cam_from_world, truth, BOX) < 1e-3


def test_the_derivative_of_gravity_is_that_of_differences():
    pose, step = poses(3)[1], 1e-6
    told = Gravity(in_world=np.array([0.1, 0.2, -1.0]), in_cam=np.array([0.3, 1.0, 0.2]))
    at = told.rows(pose, camera())
    assert isinstance(at, PriorRows)
    for axis in range(3):
        ahead, behind = (
            told.rows(nudged(pose, sign * step * np.eye(3)[axis], np.zeros(3)), camera()).residuals
            for sign in (1, -1)
        )
        assert (ahead - behind) / (2 * step) == pytest.approx(at.jacobian[:, axis], abs=1e-5)
    assert np.all(at.jacobian[:, 3:] == 0)


def test_matches_that_agree_with_no_pose_give_none():
    pixels, points, _ = matches(camera(), poses(3)[0])
    assert refine(pixels + 1000, points, poses(3)[0], camera(), max_error_px=6.0) is None


def test_another_focal_length_keeps_the_ratio_and_leaves_the_given_camera_alone():
    given = camera()
    changed = with_focal_length(given, 1005.0)
    assert changed.params == pytest.approx([1000, 1010, *camera().params[2:]])
    assert np.array_equal(given.params, camera().params)
