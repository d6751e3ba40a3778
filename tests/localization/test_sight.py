"""No result contradicts itself: its numbers, its points, its distance, and its confidence."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from scenes import camera, exact_map, poses
from slimsfm.features import Features
from slimsfm.geometry import project
from slimsfm.lenses import camera_fault
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.sight import Sight
from slimsfm.mapping.map import PointDescriptors
from slimsfm.mapping.subset import direct_map
from slimsfm.pose import PoseEstimate

POSE = poses(11)[3]


def estimate(map_, cam_from_world=POSE, **changes):
    inliers = np.ones(len(map_.point3D_ids), bool)
    found = PoseEstimate(cam_from_world=cam_from_world, inliers=inliers, covariance=1e-4 * np.eye(6))
    return replace(found, **changes)


def farther(times):
    return pycolmap.Rigid3d(POSE.rotation, times * POSE.translation)


def allows(map_, pose):
    return Sight(map_).allows(pose, map_.points3D_in_world, pose.camera or camera())


def direct(map_):
    descriptors = np.eye(len(map_.point3D_ids), dtype=np.float32)
    return direct_map(map_, PointDescriptors(points=np.arange(len(descriptors)), descriptors=descriptors))


@pytest.mark.parametrize("kind", [lambda map_: map_, direct], ids=["full", "direct"])
def test_poses_near_the_references_are_allowed_and_those_far_beyond_are_not(exact, kind):
    map_ = kind(exact)
    for times in (0.3, 1.0, 3.0, 10.0):
        assert allows(map_, estimate(map_, farther(times)))
    for times in (100.0, 24_000.0, 1e12):
        assert not allows(map_, estimate(map_, farther(times)))


def test_a_longer_lens_sees_as_much_farther(exact):
    lens = camera()
    lens.params = lens.params * [300, 300, 1, 1, 0, 0, 0, 0]
    assert allows(exact, estimate(exact, farther(300.0), camera=lens))
    assert not allows(exact, estimate(exact, farther(300.0)))


def test_numbers_that_are_none_and_points_behind_the_camera_are_not_allowed(exact):
    for value in (np.nan, np.inf):
        moved = pycolmap.Rigid3d(POSE.rotation, np.array([0.0, value, 5.0]))
        assert not allows(exact, estimate(exact, moved))
        assert not allows(exact, estimate(exact, covariance=np.full((6, 6), value)))
    assert not allows(exact, estimate(exact, farther(0.0)))
    assert not allows(exact, estimate(exact, farther(-1.0)))
    absurd = camera()
    absurd.params = [500, 500, 1e7, 240, 0, 0, 0, 0]
    assert not allows(exact, estimate(exact, camera=absurd))


def seen_with(map_, lens, noise_px, rng):
    """A query whose keypoints are where a lens sees the points, with noise and some wrong ones."""
    seen = map_.observations["001.png"]
    descriptors = np.empty((len(map_.point3D_ids), 32), np.float32)
    descriptors[seen.points] = map_.features["001.png"].descriptors[seen.rows]
    pixels = project(map_.points3D_in_world, POSE, lens) + noise_px * rng.normal(size=(len(descriptors), 2))
    inside = np.isfinite(pixels).all(axis=1)
    wrong = rng.random(len(pixels)) < 0.3
    pixels[wrong] = rng.uniform((0, 0), (lens.width, lens.height), (int(wrong.sum()), 2))
    rows = np.flatnonzero(inside | wrong)
    return Features(
        keypoints=pixels[rows].astype(np.float32),
        descriptors=descriptors[rows],
        scores=np.ones(len(rows), np.float32),
        image_size=(lens.width, lens.height),
    )


def assert_consistent(found, map_):
    pose = found.pose
    if pose is None:
        assert found.predicted_corner_error is None
        return
    numbers = [
        pose.cam_from_world.matrix(),
        pose.covariance,
        found.camera.params,
        found.predicted_corner_error,
    ]
    assert all(np.isfinite(one).all() for one in numbers)
    assert camera_fault(found.camera) is None
    assert ((pose.cam_from_world * found.points3D_in_world[pose.inliers])[:, 2] > 0).all()
    assert 0 <= pose.confidence <= 1
    assert pose.confidence < 0.95 or found.predicted_corner_error < 0.1
    plain = replace(pose, covariance=pose.covariance / 1.2**2)
    assert pose.estimated or pose.confidence <= plain.probability_within(0.1, map_.box)


@pytest.mark.parametrize("seed", range(12))
def test_whatever_camera_is_believed_the_result_is_consistent(seed):
    rng = np.random.default_rng(seed)
    map_, lens = exact_map(num_points=60), camera()
    query = seen_with(map_, lens, 10 ** rng.uniform(-1, 1.3), rng)
    believed = pycolmap.Camera(lens.todict())
    believed.params = lens.params * 10 ** rng.normal(0, 0.3, 8) + [0, 0, 0, 0, *rng.normal(0, 0.2, 4)]
    options = LocalizationOptions(focal=str(rng.choice(["known", "auto", "unknown"])), min_confidence=0.0)
    if camera_fault(believed):
        with pytest.raises(ValueError, match="camera must be possible"):
            Localizer(map_, options).localize_features(query, believed)
    else:
        assert_consistent(Localizer(map_, options).localize_features(query, believed), map_)


def test_an_absurd_camera_gives_no_pose_but_an_error(exact):
    absurd = pycolmap.Camera(
        model="OPENCV", width=640, height=480, params=[500, 500, 320, 240, 1e9, 1e9, 1e9, 1e9]
    )
    localizer = Localizer(exact)
    for localize in (localizer.localize_features, localizer.search):
        with pytest.raises(ValueError, match="camera must be possible, but its distortion"):
            localize(exact.features["001.png"], absurd)
    with pytest.raises(ValueError, match="camera must be possible, but its distortion"):
        localizer.localize(np.zeros((480, 640, 3), np.uint8), absurd)
