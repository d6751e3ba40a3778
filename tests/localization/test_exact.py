"""Laws of the exact pass."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from scenes import camera
from slimsfm.features import Features, NearestOptions
from slimsfm.geometry import corner_error
from slimsfm.localization import LocalizationOptions, Localizer, search
from slimsfm.localization.exact import ExactPass, match_around, spreads
from slimsfm.localization.point_descriptors import PointSizes
from slimsfm.localization.strategy import Query
from slimsfm.photos import read_image
from slimsfm.pose import Gravity

RADIUS_PX = 6.0
METRIC = NearestOptions()


def _query(keypoints: np.ndarray, descriptors: np.ndarray, scales=None) -> Query:
    count = len(keypoints)
    frames = None if scales is None else np.column_stack([scales, np.zeros(count)]).astype(np.float32)
    features = Features(
        keypoints=keypoints.astype(np.float32),
        descriptors=descriptors,
        scores=np.ones(count, np.float32),
        image_size=(640, 480),
        frames=frames,
    )
    return Query(
        keypoints=keypoints.astype(np.float64), descriptors=descriptors, features=features, camera=camera()
    )


def test_points_match_near_where_they_project_whatever_looks_alike_elsewhere():
    descriptors = np.eye(8, dtype=np.float32)[[0, 0, 1]]  # the second keypoint is a twin of the first
    keypoints = np.array([[100.0, 100.0], [300.0, 100.0], [200.0, 200.0]])
    target = descriptors[[0, 1, 2]], np.array([7, 8, 9])
    projections = np.array([[102.0, 101.0], [299.0, 103.0], [np.nan, np.nan]])
    found = match_around(_query(keypoints, descriptors), target, projections, RADIUS_PX, METRIC)
    assert sorted(zip(found.keypoints, found.points, strict=True)) == [(0, 7), (1, 8)]


def test_two_alike_keypoints_around_a_projection_are_no_match():
    descriptors = np.eye(8, dtype=np.float32)[[0, 0]]
    target, projection = (descriptors[:1], np.array([7])), np.array([[101.0, 100.0]])
    for distance, matches in ((0.5, 1), (4.0, 0), (50.0, 1)):  # the same place, ambiguous, out of reach
        keypoints = np.array([[100.0, 100.0], [100.0 + distance, 100.0]])
        found = match_around(_query(keypoints, descriptors), target, projection, RADIUS_PX, METRIC)
        assert len(found) == matches


def test_keypoints_and_points_are_matched_once_and_within_the_radius():
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 100, (300, 2))
    some = np.abs(rng.normal(size=(300, 16))).astype(np.float32)
    some /= np.linalg.norm(some, axis=1, keepdims=True)
    rows = rng.integers(300, size=500)
    projections = keypoints[rows] + rng.normal(0, 3, (500, 2))
    target = some[rows], rng.integers(80, size=500)
    found = match_around(_query(keypoints, some), target, projections, RADIUS_PX, METRIC)
    assert len(found) > 20
    assert len(np.unique(found.keypoints)) == len(np.unique(found.points)) == len(found)
    for keypoint, point in zip(found.keypoints, found.points, strict=True):
        at = projections[target[1] == point]
        assert np.linalg.norm(at - keypoints[keypoint], axis=1).min() <= RADIUS_PX


def test_without_keypoints_or_visible_points_nothing_matches():
    nothing, one = np.zeros((0, 2)), np.eye(8, dtype=np.float32)[:1]
    target, at = (one, np.array([0])), np.array([[5.0, 5.0]])
    assert not len(match_around(_query(nothing, one[:0]), target, at, RADIUS_PX, METRIC))
    assert not len(match_around(_query(at, one), (one[:0], target[1][:0]), nothing, RADIUS_PX, METRIC))
    assert not len(match_around(_query(at, one), target, at + 50, RADIUS_PX, METRIC))


def test_spreads_grow_with_the_scale_in_pixels_in_which_features_were_found():
    keypoints, descriptors = np.zeros((3, 2)), np.eye(8, dtype=np.float32)[:3]
    rows = np.arange(3)
    assert spreads(_query(keypoints, descriptors), rows).tolist() == [1, 1, 1]
    query = _query(keypoints, descriptors, scales=np.array([1.0, 4.0, 16.0]))
    found = spreads(query, rows)
    assert np.all(np.diff(found) > 0)
    assert found.min() >= 1
    twice = replace(_query(keypoints, descriptors, scales=np.array([2.0, 8.0, 32.0])), shrink_factor=2.0)
    assert spreads(twice, rows) == pytest.approx(found)


def test_sure_poses_become_more_exact(boulder, monkeypatch):
    changes = []
    for strategy in ("direct", "exhaustive", "progressive", "retrieval"):
        localizer = Localizer(boulder.map, LocalizationOptions(strategy=strategy))
        for path, lens, truth in zip(
            boulder.query.image_paths, boulder.query.cameras, boulder.query.cam_from_world, strict=True
        ):
            features = localizer.extractor.extract(read_image(path))
            exact = localizer.localize_features(features, lens)
            with monkeypatch.context() as patched:
                patched.setattr(search, "CONVINCING", 2.0)
                before = localizer.localize_features(features, lens)
            if before.pose is None or exact.pose is None:
                continue
            errors = [
                corner_error(one.pose.cam_from_world, truth, boulder.map.box) for one in (before, exact)
            ]
            changes.append(np.log(errors[1] / errors[0]))
            assert exact.pose.num_inliers >= before.pose.num_inliers
            assert len(exact.points2D) == len(exact.points3D_in_world) == len(exact.pose.inliers)
            assert exact.references == before.references
    assert len(changes) > 4
    assert np.mean(changes) < 0


def test_poses_with_estimated_intrinsics_stay_as_they_are(boulder):
    localizer = Localizer(boulder.map)
    path, wrong = boulder.query.image_paths[0], pycolmap.Camera(boulder.query.cameras[0].todict())
    wrong.params = wrong.params * np.array([1.3, *np.ones(len(wrong.params) - 1)])
    found = localizer.search(localizer.extractor.extract(read_image(path)), wrong).best
    assert found.pose.camera is not None
    exact = ExactPass(boulder.map, localizer._strategy, PointSizes(boulder.map))
    assert exact.refined(found.query, found.matches, found.pose, found.camera, RADIUS_PX) is None


def test_poses_with_gravity_keep_its_prior(boulder, monkeypatch):
    path, truth = boulder.query.image_paths[0], boulder.query.cam_from_world[0]
    down = np.array([0.0, 0.0, -1.0])
    gravity = Gravity(in_world=down, in_cam=truth.rotation.matrix() @ down, uncertainty_deg=1.0)
    localizer = Localizer(boulder.map)
    image, lens = read_image(path), boulder.query.cameras[0]
    poses = [localizer.localize(image, lens, gravity).pose.cam_from_world.matrix()]
    monkeypatch.setattr(search, "CONVINCING", 2.0)
    poses.append(localizer.localize(image, lens, gravity).pose.cam_from_world.matrix())
    assert np.array_equal(*poses)
