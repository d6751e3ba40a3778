"""Laws of the refinement whose loss has the scale of the scatter of its own matches."""

import numpy as np
import pycolmap
import pytest

from slimsfm.pose import RansacOptions, estimate_pose
from slimsfm.pose.ransac import PinholeMatches
from slimsfm.pose.scatter import refine_to_scatter

CAMERA = pycolmap.Camera(
    model="PINHOLE", width=320, height=240, params=[300.0, 300.0, 160.0, 120.0], camera_id=1
)
TRUE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.2, -0.1, 0.3])), np.array([0.1, -0.2, 6.0]))
NOISE_PX = 0.1


def _matches(seed: int, wrong_px: float, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Right matches, of which two at one side are off in the same direction."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.7, 0.7, (count, 3))
    pixels = np.asarray(CAMERA.img_from_cam(TRUE * points)) + rng.normal(0, NOISE_PX, (count, 2))
    pixels[np.argsort(points[:, 0])[:2]] += (0, wrong_px)
    return pixels, points


def _error(found: pycolmap.Rigid3d) -> float:
    motion = TRUE * found.inverse()
    return float(motion.rotation.angle() + np.linalg.norm(motion.translation) / 6)


@pytest.mark.parametrize("limit_px", [2.0, 6.0, 12.0])
def test_wrong_matches_within_the_limit_do_not_move_the_pose(limit_px):
    for seed in range(10):
        errors = []
        for wrong_px in (0.0, 5.0):
            pose = estimate_pose(*_matches(seed, wrong_px), CAMERA, RansacOptions(max_error_px=limit_px))
            assert pose is not None
            errors.append(_error(pose.cam_from_world))
        assert errors[1] < errors[0] + 1e-3


def test_the_pose_does_not_depend_on_the_limit():
    pixels, points = _matches(3, 5.0)
    found = [estimate_pose(pixels, points, CAMERA, RansacOptions(max_error_px=px)) for px in (1.5, 3.0, 6.0)]
    matrices = [one.cam_from_world.matrix() for one in found if one is not None]
    assert len(matrices) == 3
    assert np.ptp(matrices, axis=0).max() < 1e-3


def test_exact_matches_keep_the_exact_pose():
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (30, 3))
    matches = PinholeMatches.of(np.asarray(CAMERA.img_from_cam(TRUE * points)), points, CAMERA)
    assert np.allclose(refine_to_scatter(matches, TRUE, 6.0).matrix(), TRUE.matrix(), atol=1e-9)


def test_a_pose_far_from_all_matches_stays_as_it_is():
    pixels, points = _matches(0, 0.0)
    matches = PinholeMatches.of(pixels + 100, points, CAMERA)
    assert refine_to_scatter(matches, TRUE, 6.0) is TRUE


def test_errors_are_those_of_pycolmap_and_infinite_behind_the_camera():
    pixels, points = _matches(1, 5.0)
    points[0] = TRUE.inverse() * np.array([0.1, 0.2, -1.0])
    errors = PinholeMatches.of(pixels, points, CAMERA).errors(TRUE)
    seen = np.asarray(CAMERA.img_from_cam(TRUE * points[1:]))
    assert errors[0] == np.inf
    assert errors[1:] == pytest.approx(np.linalg.norm(seen - pixels[1:], axis=1))
