"""Laws of the weighted refinement, on points and cameras that are known exactly."""

import numpy as np
import pycolmap
import pytest

from slimsfm.geometry import motions
from slimsfm.pose.types import MIN_SIGMA_PX
from slimsfm.pose.weighted import refine_weighted

CAMERA = pycolmap.Camera(
    model="OPENCV",
    width=1000,
    height=800,
    params=[900.0, 910.0, 500.0, 400.0, -0.05, 0.01, 1e-3, -1e-3],
    camera_id=1,
)
TRUE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.2, -0.1, 0.3])), np.array([0.1, -0.2, 6.0]))
START = (
    pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([1e-3, -1e-3, 2e-3])), np.array([4e-3, 6e-3, -8e-3])) * TRUE
)
LIMIT_PX = 60.0  # nothing is cut off, so the statistics are those of the loss alone


def _scene(seed: int, count: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, their exact pixels, and spreads from 1 to 16."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.5, 1.5, (count, 3))
    return points, np.asarray(CAMERA.img_from_cam(TRUE * points)), 2 ** rng.uniform(0, 4, count)


def _motion(found: pycolmap.Rigid3d) -> np.ndarray:
    """The small motion from a pose to the true one: rotation, then translation."""
    motion = TRUE * found.inverse()
    return np.concatenate(
        [2 * motion.rotation.quat[:3] * np.sign(motion.rotation.quat[3]), motion.translation]
    )


def test_exact_matches_give_the_exact_pose():
    points, pixels, spreads = _scene(0)
    found = refine_weighted(pixels, points, START, CAMERA, spreads, max_error_px=LIMIT_PX)
    assert np.abs(_motion(found.cam_from_world)).max() < 1e-6
    assert found.inliers.all()


def test_only_the_ratios_of_spreads_matter():
    points, pixels, spreads = _scene(1)
    pixels += spreads[:, None] * np.random.default_rng(1).normal(0, 0.5, pixels.shape)
    one, other = (
        refine_weighted(pixels, points, START, CAMERA, factor * spreads, max_error_px=LIMIT_PX)
        for factor in (1, 4)
    )
    assert np.allclose(one.cam_from_world.matrix(), other.cam_from_world.matrix(), atol=1e-7)


@pytest.fixture(scope="module")
def trials() -> dict[str, np.ndarray]:
    """Errors of 150 poses from matches whose noise is proportional to their spread."""
    found: dict[str, list] = {"weighted": [], "unweighted": [], "predicted": []}
    for seed in range(150):
        points, pixels, spreads = _scene(seed)
        pixels += spreads[:, None] * np.random.default_rng(seed).normal(0, 1, pixels.shape)
        for name, used in (("weighted", spreads), ("unweighted", np.ones(len(spreads)))):
            one = refine_weighted(pixels, points, START, CAMERA, used, max_error_px=LIMIT_PX)
            found[name].append(_motion(one.cam_from_world))
            if name == "weighted":
                found["predicted"].append(one.covariance)
    return {name: np.array(values) for name, values in found.items()}


def test_weights_lower_the_error(trials):
    weighted, unweighted = (
        np.sqrt(np.mean(trials[name] ** 2, axis=0)) for name in ("weighted", "unweighted")
    )
    assert np.all(weighted < 0.7 * unweighted)


def test_the_covariance_is_that_of_the_errors(trials):
    whitened = [
        error @ np.linalg.solve(covariance, error)
        for error, covariance in zip(trials["weighted"], trials["predicted"], strict=True)
    ]
    assert np.sqrt(np.mean(whitened) / 6) == pytest.approx(1, abs=0.1)


def test_no_keypoint_is_more_exact_than_the_least_sigma():
    points, pixels, spreads = _scene(2)
    found = refine_weighted(pixels, points, START, CAMERA, spreads, max_error_px=LIMIT_PX)
    in_cam = found.cam_from_world * points
    jacobian = np.zeros((len(points), 2, 6))
    for axis in range(3):  # pixels per unit of motion of the point, by differences
        step = 1e-6 * np.eye(3)[axis]
        change = np.asarray(CAMERA.img_from_cam(in_cam + step)) - np.asarray(
            CAMERA.img_from_cam(in_cam - step)
        )
        jacobian += change[:, :, None] / 2e-6 * motions(in_cam)[:, axis][:, None, :]
    rows = (jacobian / (MIN_SIGMA_PX * spreads[:, None, None])).reshape(-1, 6)
    expected = np.linalg.inv(rows.T @ rows)
    # the covariance is that of undistorted pixels, which differ a little in size
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(np.sqrt(np.diag(expected)), rel=0.1)


def test_outliers_hardly_matter():
    points, pixels, spreads = _scene(3)
    rng = np.random.default_rng(3)
    pixels += spreads[:, None] * rng.normal(0, 0.1, pixels.shape)
    clean = refine_weighted(pixels, points, START, CAMERA, spreads, max_error_px=6.0)
    pixels[::5] += rng.uniform(-50, 50, (40, 2))
    found = refine_weighted(pixels, points, START, CAMERA, spreads, max_error_px=6.0)
    difference = (_motion(found.cam_from_world) - _motion(clean.cam_from_world)) / np.sqrt(
        np.diag(clean.covariance)
    )
    assert np.abs(difference).max() < 1


def test_too_few_matches_leave_the_pose():
    points, pixels, spreads = _scene(4)
    found = refine_weighted(pixels[:3], points[:3], START, CAMERA, spreads[:3], max_error_px=6.0)
    assert found.cam_from_world is START
    assert found.covariance is None
