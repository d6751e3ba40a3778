from dataclasses import replace

import numpy as np
import pytest

from scenes import exact_map
from slimsfm.features import unit_rows
from slimsfm.localization.appearances import find_appearances
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.map import observed
from slimsfm.mapping.subset import keep_images
from slimsfm.selection.usable_points import LeftOut, selection_problem


@pytest.fixture(scope="module")
def one_sided():
    """Eight images that see half of the points each, no two of their descriptors quite equal."""
    map_, rng = exact_map(num_images=8, num_points=80, reach_deg=80), np.random.default_rng(0)
    features = {
        name: replace(one, descriptors=unit_rows(one.descriptors + noise(rng, one.descriptors.shape)))
        for name, one in map_.features.items()
    }
    return replace(map_, features=features)


def noise(rng, shape):
    return rng.normal(0, 0.03, shape).astype(np.float32)


def test_an_image_observes_the_points_of_its_tracks(one_sided):
    dense = observed(one_sided).toarray()
    for row, image in enumerate(one_sided.images.values()):
        ids = {point.point3D_id for point in image.points2D if point.has_point3D()}
        assert set(one_sided.point3D_ids[dense[row]]) == ids


def test_on_an_exact_scene_the_usable_points_are_the_observed_ones(one_sided):
    problem = selection_problem(one_sided, LeftOut(one_sided))
    assert np.array_equal(problem.usable.toarray(), observed(one_sided).toarray())
    assert problem.twists.shape == (problem.usable.nnz, 2, 6)
    assert problem.usable.has_canonical_format


def test_a_keypoint_elsewhere_makes_its_point_unusable_there(one_sided):
    dense = observed(one_sided).toarray()
    name, point = next(iter(one_sided.images)), int(np.flatnonzero(dense[0])[0])
    seen = one_sided.observations[name]
    keypoints = one_sided.features[name].keypoints.copy()
    keypoints[seen.rows[seen.points == point]] += 10.0
    features = {**one_sided.features, name: replace(one_sided.features[name], keypoints=keypoints)}
    elsewhere = replace(one_sided, features=features)
    dense[0, point] = False
    assert np.array_equal(selection_problem(elsewhere, LeftOut(elsewhere)).usable.toarray(), dense)


def test_points_are_described_as_by_a_map_without_the_image():
    steady = exact_map(num_images=8, num_points=80, reach_deg=80)
    left_out, points = LeftOut(steady), np.arange(len(steady.point3D_ids))
    for name in steady.images:
        without = keep_images(steady, [other for other in steady.images if other != name])
        rows = np.searchsorted(steady.point3D_ids, without.point3D_ids)
        descriptors, known = left_out.describe(points, name)
        assert np.array_equal(known, rows)
        assert descriptors == pytest.approx(describe_points(without).descriptors, abs=1e-5)
        some = points[::3]
        fewer = np.isin(known, some)
        assert np.array_equal(left_out.describe(some, name)[0], descriptors[fewer])
        assert np.array_equal(left_out.describe(some, name)[1], known[fewer])


def test_without_an_image_appearances_are_the_means_of_the_other_observations():
    map_, rng = exact_map(num_images=8, num_points=80, reach_deg=80), np.random.default_rng(0)
    features = {
        name: replace(one, descriptors=unit_rows(one.descriptors + 3 * noise(rng, one.descriptors.shape)))
        for name, one in map_.features.items()
    }
    one_sided = replace(map_, features=features)
    found, left_out = find_appearances(one_sided), LeftOut(one_sided)
    assert len(found.points) > len(one_sided.point3D_ids)
    for left in one_sided.images:
        sums, counts = np.zeros_like(found.sums), np.zeros(len(found.points), np.int64)
        for name, rows in found.of_observations.items():
            if name != left:
                own = one_sided.observations[name].rows
                np.add.at(sums, rows, unit_rows(one_sided.features[name].descriptors[own]))
                np.add.at(counts, rows, 1)
        descriptors, points = left_out.describe(np.arange(len(one_sided.point3D_ids)), left)
        assert np.array_equal(points, found.points[counts > 0])
        assert descriptors == pytest.approx(unit_rows(sums[counts > 0]), abs=1e-4)


def test_leaving_images_out_changes_nothing_for_the_next(one_sided):
    left_out, points = LeftOut(one_sided), np.arange(len(one_sided.point3D_ids))
    first, second = list(one_sided.images)[:2]
    once = left_out.describe(points, first)
    left_out.describe(points, second)
    again = left_out.describe(points, first)
    assert all(np.array_equal(*pair) for pair in zip(once, again, strict=True))


def test_the_query_is_the_image_itself(one_sided):
    name = next(iter(one_sided.images))
    query, features = LeftOut(one_sided).query(name), one_sided.features[name]
    assert query.descriptors == pytest.approx(features.descriptors, abs=1e-6)
    assert np.array_equal(query.keypoints, features.keypoints)


def test_points_that_only_one_image_observes_are_not_usable():
    map_ = exact_map(num_images=4, num_points=60)
    first = next(iter(map_.images))
    alone = keep_images(map_, [first])
    assert selection_problem(alone, LeftOut(alone)).usable.nnz == 0


def test_matches_are_judged_by_the_metric_of_the_maps_extractor():
    """Right matches about 0.8 radians apart are found with ALIKED's thresholds, not with SIFT's."""
    map_, rng = exact_map(num_images=8, num_points=80, reach_deg=80), np.random.default_rng(0)
    features = {
        name: replace(one, descriptors=unit_rows(one.descriptors + 5 * noise(rng, one.descriptors.shape)))
        for name, one in map_.features.items()
    }
    usable = {}
    for extractor in ("sift", "aliked"):
        scattered = replace(map_, features=features, info=replace(map_.info, extractor=extractor))
        usable[extractor] = selection_problem(scattered, LeftOut(scattered)).usable.nnz
    seen = observed(map_).nnz
    assert usable["sift"] < 0.3 * seen
    assert usable["aliked"] > 0.6 * seen
