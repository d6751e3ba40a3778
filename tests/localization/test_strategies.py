import copy
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from scenes import BOX, camera, poses
from slimsfm.features import Features, unit_rows
from slimsfm.geometry import corner_error, project
from slimsfm.localization import STRATEGIES, LocalizationOptions, Localizer
from slimsfm.localization.direct import describe_points
from slimsfm.localization.strategy import Strategy, unite
from slimsfm.mapping.direct import direct_map, with_points
from slimsfm.mapping.map import Map

TENTH_OF_A_PER_MILLE = 1e-4


@pytest.fixture(params=sorted(STRATEGIES))
def options(request) -> LocalizationOptions:
    return LocalizationOptions(strategy=request.param)


def features(keypoints, descriptors) -> Features:
    return Features(
        keypoints=np.asarray(keypoints, np.float32),
        descriptors=np.asarray(descriptors, np.float32),
        scores=np.ones(len(keypoints), np.float32),
        image_size=(640, 480),
    )


def descriptors_of_points(map_: Map) -> np.ndarray:
    name, seen = next(iter(map_.observations.items()))
    found = np.empty((len(map_.point3D_ids), 32), np.float32)
    found[seen.points] = map_.features[name].descriptors[seen.rows]
    return found


def renamed(map_: Map) -> Map:
    """The same map with the images' names, and so their order, turned round."""
    names = dict(zip(map_.images, reversed([f"x{name}" for name in map_.images]), strict=True))
    model = copy.deepcopy(map_.model)
    for image in model.images.values():
        image.name = names[image.name]
    return replace(
        map_, model=model, matches={}, features={names[name]: map_.features[name] for name in map_.images}
    )


def test_a_reference_as_query_gets_its_own_pose_back(exact, options):
    localizer = Localizer(exact, options)
    for name, image in exact.images.items():
        found = localizer.localize_features(exact.features[name], camera()).pose
        assert corner_error(found.cam_from_world, image.cam_from_world(), BOX) < TENTH_OF_A_PER_MILLE
        assert found.num_inliers == len(exact.observations[name].rows)


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"])
def test_a_new_view_through_any_lens_is_localized(exact, options, model):
    lens = pycolmap.Camera.create_from_model_name(7, model, 450.0, 640, 480)
    lens.params = lens.params + np.where(lens.params == 0, 0.03, 0.0)
    cam_from_world = poses(17)[5]
    keypoints = project(exact.points3D_in_world, cam_from_world, lens)
    query = features(keypoints, descriptors_of_points(exact))
    found = Localizer(exact, options).localize_features(query, lens)
    assert corner_error(found.pose.cam_from_world, cam_from_world, BOX) < TENTH_OF_A_PER_MILLE
    assert found.num_matches == len(exact.point3D_ids)


def test_an_unrelated_query_has_no_pose(exact, options):
    rng = np.random.default_rng(1)
    query = features(rng.uniform(0, 480, (200, 2)), unit_rows(rng.normal(size=(200, 32))))
    assert Localizer(exact, options).localize_features(query, camera()).pose is None


def test_a_query_without_features_has_no_pose(exact, options):
    found = Localizer(exact, options).localize_features(
        features(np.zeros((0, 2)), np.zeros((0, 32))), camera()
    )
    assert found.pose is None
    assert found.num_matches == 0


def test_names_and_order_of_the_references_do_not_matter(exact, options):
    shuffled = renamed(exact)
    assert list(shuffled.images) != list(exact.images)
    for query in exact.features.values():
        a, b = (Localizer(one, options).localize_features(query, camera()) for one in (exact, shuffled))
        assert a.num_matches == b.num_matches
        assert corner_error(a.pose.cam_from_world, b.pose.cam_from_world, BOX) < 1e-9


def test_equal_queries_get_equal_poses(exact, options):
    query = exact.features["002.png"]
    localizer = Localizer(exact, options)
    found = [localizer.localize_features(query, camera()).pose for _ in range(2)]
    found.append(Localizer(exact, options).localize_features(query, camera()).pose)
    matrices = [pose.cam_from_world.matrix() for pose in found]
    assert np.array_equal(matrices[0], matrices[1])
    assert np.array_equal(matrices[0], matrices[2])


def test_matches_are_sorted_name_what_exists_and_occur_once(exact, options):
    localizer = Localizer(exact, options)
    strategy = localizer._strategy
    assert isinstance(strategy, Strategy)
    query = unit_rows(exact.features["003.png"].descriptors)
    matches = strategy.match(query)
    pairs = list(zip(matches.keypoints.tolist(), matches.points.tolist(), strict=True))
    assert pairs == sorted(set(pairs))
    assert len(matches) == len(pairs) == len(exact.point3D_ids)
    assert max(matches.keypoints) < len(query)
    assert max(matches.points) < len(exact.point3D_ids)


@given(st.lists(arrays(np.int64, st.tuples(st.integers(0, 5), st.just(2)), elements=st.integers(0, 3))))
def test_uniting_is_the_union_of_sets(parts):
    matches = unite(parts)
    united = sorted({tuple(row) for part in parts for row in part.tolist()})
    assert list(zip(matches.keypoints.tolist(), matches.points.tolist(), strict=True)) == united


def test_an_unknown_strategy_is_named():
    with pytest.raises(ValueError, match="strategy must be auto or one of direct, exhaustive, got 'guess'"):
        LocalizationOptions(strategy="guess")


def test_by_itself_it_matches_points_where_the_map_has_some_chosen_for_it(exact):
    options = LocalizationOptions()
    assert options.strategy == "auto"
    assert options.strategy_for(exact) == "exhaustive"
    chosen = describe_points(exact)
    for map_ in (direct_map(exact, chosen), with_points(exact, exact, chosen)):
        assert options.strategy_for(map_) == "direct"
        assert LocalizationOptions(strategy="exhaustive").strategy_for(map_) == "exhaustive"
    assert LocalizationOptions(strategy="direct").strategy_for(exact) == "direct"
