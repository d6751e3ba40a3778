import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes import BOX, poses
from slimsfm.geometry import corner_error, rotation_error_deg
from slimsfm.tracking.track import predicted_pose, smoothed_pose

quick = settings(deadline=None, max_examples=25)
HERE, THERE = poses(24)[:2]
STEP = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.01, 0.02, -0.03])), np.array([0.02, -0.01, 0.05]))


def test_constant_velocity_is_predicted_exactly():
    path = [HERE]
    for _ in range(5):
        path.append(STEP * path[-1])
    for before, now, after in zip(path, path[1:], path[2:], strict=False):
        assert np.allclose(predicted_pose(now, before).matrix(), after.matrix(), atol=1e-12)


def test_still_camera_is_predicted_to_stay():
    assert np.allclose(predicted_pose(HERE, HERE).matrix(), HERE.matrix(), atol=1e-12)


def test_strength_0_changes_nothing():
    assert smoothed_pose(THERE, HERE, BOX, 0.0) is THERE


@quick
@given(strength=st.floats(0, 100))
def test_constant_pose_is_unchanged(strength):
    assert np.allclose(smoothed_pose(HERE, HERE, BOX, strength).matrix(), HERE.matrix(), atol=1e-12)


@quick
@given(strength=st.floats(0.1, 30))
def test_smoothed_pose_lies_between_both_poses(strength):
    smoothed = smoothed_pose(THERE, HERE, BOX, strength)
    assert corner_error(smoothed, THERE, BOX) < corner_error(HERE, THERE, BOX)
    turned, whole = rotation_error_deg(HERE, smoothed), rotation_error_deg(HERE, THERE)
    assert turned + rotation_error_deg(smoothed, THERE) == pytest.approx(whole, abs=1e-6)


@pytest.mark.parametrize("strength", [1.0, 5.0, 20.0])
def test_large_step_is_followed_at_once(strength):
    smoothed = smoothed_pose(THERE, HERE, BOX, strength)
    assert corner_error(smoothed, THERE, BOX) < 0.02 * corner_error(HERE, THERE, BOX)


@pytest.mark.parametrize("strength", [1.0, 5.0, 20.0])
def test_small_step_is_followed_within_a_few_frames(strength):
    near = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([1e-3, 0, 0])) * HERE
    pose, first = HERE, corner_error(HERE, near, BOX)
    for _ in range(round(5 * (1 + strength))):
        pose = smoothed_pose(near, pose, BOX, strength)
    assert corner_error(pose, near, BOX) < 0.01 * first


def test_jitter_is_reduced_pose():
    rng = np.random.default_rng(0)
    noise = [pycolmap.Rotation3d(1e-4 * rng.normal(size=3)) for _ in range(200)]
    raw = [pycolmap.Rigid3d(turn, np.zeros(3)) * HERE for turn in noise]
    pose, smoothed = HERE, []
    for one in raw:
        pose = smoothed_pose(one, pose, BOX, 10.0)
        smoothed.append(pose)
    before, after = (np.mean([corner_error(one, HERE, BOX) for one in path]) for path in (raw, smoothed))
    assert after < 0.4 * before


def test_rotation_by_180_degrees_gives_finite_poses():
    for angle in (np.pi - 1e-9, np.pi, np.pi + 1e-9):
        turned = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0, angle])), np.zeros(3)) * HERE
        assert np.isfinite(smoothed_pose(turned, HERE, BOX, 5.0).matrix()).all()
