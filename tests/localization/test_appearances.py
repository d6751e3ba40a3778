"""Laws of points that look different from image to image."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from scenes import camera, exact_map
from slimsfm.features import Features, NearestOptions, unit_rows
from slimsfm.geometry import corner_error, project
from slimsfm.localization import Localizer
from slimsfm.localization.appearances import MOST_APPEARANCES, find_appearances
from slimsfm.localization.exact import match_around
from slimsfm.localization.matching import match_near, match_target
from slimsfm.localization.point_descriptors import describe_points, viewing_directions
from slimsfm.localization.strategies import Direct
from slimsfm.localization.strategy import Query, some_points
from slimsfm.localization.verification import _found_there_alone
from slimsfm.mapping.map import Map

AROUND_PX = 6.0


def with_looks(map_: Map, count: int, seed: int = 0) -> Map:
    """The map with unlike descriptors in every `count`-th image, by extractor SIFT's metric."""
    rng, width = np.random.default_rng(seed), 32
    looks = unit_rows(rng.normal(size=(count * len(map_.point3D_ids), width)).astype(np.float32))
    features = {}
    for place, (name, seen) in enumerate(map_.observations.items()):
        descriptors = map_.features[name].descriptors.copy()
        descriptors[seen.rows] = looks[count * seen.points + place % count]
        features[name] = replace(map_.features[name], descriptors=descriptors)
    return replace(map_, features=features, global_descriptors=None)


@pytest.fixture(scope="module")
def changing() -> Map:
    """A map whose points look one way in half of the images, and another in the others."""
    return with_looks(exact_map(12, 150), 2)


def test_a_point_that_looks_the_same_everywhere_has_one_appearance(exact):
    found = find_appearances(exact)
    assert np.array_equal(found.points, np.arange(len(exact.point3D_ids)))


@pytest.mark.parametrize(("looks", "appearances"), [(1, 1), (2, 2), (3, 3), (6, MOST_APPEARANCES)])
def test_a_point_has_as_many_appearances_as_it_has_looks_up_to_four(looks, appearances):
    found = find_appearances(with_looks(exact_map(12, 40), looks))
    assert np.array_equal(np.bincount(found.points), np.full(40, appearances))


def test_every_observation_belongs_to_an_appearance_of_its_point(changing):
    found = find_appearances(changing)
    sums = np.zeros_like(found.sums)
    for name, rows in found.of_observations.items():
        seen = changing.observations[name]
        assert np.array_equal(found.points[rows], seen.points)
        np.add.at(sums, rows, unit_rows(changing.features[name].descriptors[seen.rows]))
    assert found.sums == pytest.approx(sums, abs=1e-5)


def test_appearances_are_the_looks(changing):
    described = describe_points(changing)
    for name, rows in find_appearances(changing).of_observations.items():
        own = changing.features[name].descriptors[changing.observations[name].rows]
        assert described.descriptors[rows] == pytest.approx(own, abs=1e-5)


def test_what_a_point_has_once_is_equal_for_all_of_its_appearances(changing):
    described = describe_points(changing)
    assert len(described.firsts) == len(changing.point3D_ids) < len(described.points)
    for values in (described.directions, described.distinct):
        assert np.array_equal(values, values[described.firsts][described.points])
    assert np.array_equal(described.directions, viewing_directions(changing)[described.points])


def test_images_of_either_look_are_localized_directly(changing):
    localizer = Localizer(replace(changing, point_descriptors=describe_points(changing)))
    for name in list(changing.images)[:2]:
        found = localizer.localize_features(changing.features[name], camera=changing.camera(name))
        truth = changing.images[name].cam_from_world()
        assert corner_error(found.pose.cam_from_world, truth, changing.box) < 1e-3
        assert found.pose.confidence > 0.9


def query_of(keypoints: np.ndarray, descriptors: np.ndarray) -> Query:
    features = Features(
        keypoints=keypoints.astype(np.float32),
        descriptors=descriptors,
        scores=np.ones(len(keypoints), np.float32),
        image_size=(640, 480),
    )
    return Query(
        keypoints=keypoints.astype(np.float64), descriptors=descriptors, features=features, camera=camera()
    )


@pytest.fixture(scope="module")
def seen(changing):
    """Keypoints of an image, with noise, and what they are matched with: each point twice, or repeated."""
    rng, name = np.random.default_rng(1), next(iter(changing.images))
    rows = changing.observations[name].rows
    exact_ = unit_rows(changing.features[name].descriptors[rows])
    noisy = unit_rows(exact_ + rng.normal(0, 0.03, exact_.shape).astype(np.float32))
    query = query_of(changing.features[name].keypoints[rows], noisy)
    pose: pycolmap.Rigid3d = changing.images[name].cam_from_world()
    described = describe_points(changing)
    return query, (described.descriptors, described.points), pose


def pairs_of(matches):
    return sorted(zip(matches.keypoints.tolist(), matches.points.tolist(), strict=True))


def pixels_of(map_, target, pose):
    return project(map_.points3D_in_world[target[1]], pose, camera())


def test_repeated_appearances_change_no_match(changing, seen):
    query, target, pose = seen
    again = np.repeat(np.arange(len(target[1])), np.random.default_rng(0).integers(1, 4, len(target[1])))
    repeated = target[0][again], target[1][again]
    metric = NearestOptions()
    ways = (
        lambda one: match_target(query.descriptors, one, metric),
        lambda one: match_near(query, one, pixels_of(changing, one, pose), camera(), metric),
        lambda one: match_around(query, one, pixels_of(changing, one, pose), AROUND_PX, metric),
    )
    for match in ways:
        assert len(match(target)) > 100
        assert pairs_of(match(repeated)) == pairs_of(match(target))
    found = [
        _found_there_alone(query, pixels_of(changing, one, pose), one, metric.max_distance)
        for one in (target, repeated)
    ]
    assert len(found[0]) == len(changing.point3D_ids)
    assert np.array_equal(*found)
    assert found[0].mean() > 0.9


def test_appearances_of_one_point_are_no_rivals():
    """Two nearly equal appearances fail the ratio test as two points, and pass it as one."""
    descriptors = np.eye(4, dtype=np.float32)[[0, 0, 1]]
    descriptors[1, 2] = 0.05
    query = unit_rows(descriptors[:1] + np.float32([0, 0, 0.024, 0]))
    target = unit_rows(descriptors)
    metric = NearestOptions()
    assert not len(match_target(query, (target, np.array([3, 4, 5])), metric))
    assert pairs_of(match_target(query, (target, np.array([3, 3, 5])), metric)) == [(0, 3)]


def test_a_keypoint_matches_the_point_of_its_best_appearance_and_a_point_one_keypoint():
    rng = np.random.default_rng(0)
    looks = unit_rows(rng.normal(size=(90, 32)).astype(np.float32))
    points = np.repeat(np.arange(30), 3)
    order = rng.permutation(90)
    noisy = unit_rows(looks[order] + rng.normal(0, 0.02, (90, 32)).astype(np.float32))
    found = match_target(noisy, (looks, points), NearestOptions())
    assert np.array_equal(found.points, points[order][found.keypoints])
    assert np.array_equal(np.sort(found.points), np.arange(30))


def test_points_are_thinned_out_with_all_of_their_appearances(changing):
    points = describe_points(changing).points
    rows = some_points(points, 40)
    assert len(np.unique(points[rows])) == 40
    assert np.array_equal(rows, np.flatnonzero(np.isin(points, points[rows])))
    assert np.array_equal(some_points(points, 10_000), np.arange(len(points)))


def test_visible_points_come_with_all_of_their_appearances():
    one_sided = with_looks(exact_map(12, 150, reach_deg=80), 2)
    described = describe_points(one_sided)
    strategy = Direct(replace(one_sided, point_descriptors=described))
    _, points = strategy.visible_points(next(iter(one_sided.images.values())).cam_from_world())
    assert 0 < len(points) < len(described.points)
    assert np.array_equal(points, described.of(points).points)
