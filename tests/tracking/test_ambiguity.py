import numpy as np
import pycolmap
import pytest

from scenes import BOX, camera, poses
from slimsfm.geometry import project
from slimsfm.tracking.background import is_ambiguous

CAMERA = camera("PINHOLE")


def seen(points3D, cam_from_world, noise_px=0.3):
    noise = np.random.default_rng(0).normal(0, noise_px, (len(points3D), 2))
    return project(points3D, cam_from_world, CAMERA) + noise


def spread_over(side, depth, count=30):
    """Points around the center of the scene, in a square of this side, up to `depth` / 2 off its plane."""
    return np.random.default_rng(1).uniform(-0.5, 0.5, (count, 3)) * (side, side, depth)


@pytest.mark.parametrize("pose", poses(4), ids=str)
def test_small_label_is_ambiguous(pose):
    label = spread_over(0.25, 0.0)
    assert is_ambiguous(seen(label, pose), label, pose, CAMERA, BOX)


@pytest.mark.parametrize("pose", poses(4), ids=str)
@pytest.mark.parametrize(("side", "depth"), [(0.25, 0.25), (2.0, 0.0), (2.0, 1.0)], ids=str)
def test_points_with_depth_or_on_a_large_plane_are_not_ambiguous(side, depth, pose):
    points = spread_over(side, depth)
    assert not is_ambiguous(seen(points, pose), points, pose, CAMERA, BOX)


def test_frontal_plane_is_not_ambiguous():
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, 5.0]))
    label = spread_over(0.8, 0.0)
    assert not is_ambiguous(seen(label, pose, 0.05), label, pose, CAMERA, BOX)
