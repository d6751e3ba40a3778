import copy
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

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
from slimsfm.localization.options import load_strategy
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.localization.strategy import MatchingOptions, PointMatches, Query, Strategy, unite
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import direct_map, with_points
from strategies import CLASSICAL

TENTH_OF_A_PER_MILLE = 1e-4


@pytest.fixture(params=CLASSICAL)
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
    """The same map with the names of the images, and so their order, reversed."""
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
        assert found.num_inliers == len(found.inliers)
        assert found.confidence > 0.9


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"])
def test_a_new_view_through_any_lens_is_localized(exact, options, model):
    lens = pycolmap.Camera.create_from_model_name(7, model, 450.0, 640, 480)
    lens.params = lens.params + np.where(lens.params == 0, 0.03, 0.0)
    cam_from_world = poses(17)[5]
    keypoints = project(exact.points3D_in_world, cam_from_world, lens)
    query = features(keypoints, descriptors_of_points(exact))
    found = Localizer(exact, options).localize_features(query, lens)
    assert corner_error(found.pose.cam_from_world, cam_from_world, BOX) < TENTH_OF_A_PER_MILLE
    assert found.pose.num_inliers == found.num_matches


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


def test_each_round_yields_all_matches_so_far_sorted_and_unique(exact, options):
    strategy = strategy_of(exact, options)
    assert isinstance(strategy, Strategy)
    of_image = exact.features["003.png"]
    query = Query(
        keypoints=of_image.keypoints.astype(float),
        descriptors=unit_rows(of_image.descriptors),
        features=of_image,
        camera=camera(),
    )
    rounds = [
        list(zip(matches.keypoints.tolist(), matches.points.tolist(), strict=True))
        for matches in strategy.rounds(query)
    ]
    for before, pairs in pairwise([[], *rounds]):
        assert pairs == sorted(set(pairs))
        assert set(pairs) >= set(before)
    seen = exact.observations["003.png"]
    assert rounds[-1] == list(zip(seen.rows.tolist(), seen.points.tolist(), strict=True))


def test_visible_points_are_those_that_the_image_observes(exact, options):
    strategy = strategy_of(exact, options)
    for name, image in exact.images.items():
        for agreeing in (None, exact.observations[name].points[:20]):
            expected, points = strategy.visible_points(image.cam_from_world(), agreeing)
            assert len(expected) == len(points) > 0
            assert np.allclose(expected, descriptors_of_points(exact)[points], atol=1e-5)
            assert np.isin(points, exact.observations[name].points).all()


@pytest.mark.parametrize("kept", [1, 2, 5])
def test_retrieval_matches_with_the_requested_number_of_images(exact, kept):
    options = LocalizationOptions(strategy="retrieval", matching=MatchingOptions(retrieved=kept))
    localizer = Localizer(exact, options)
    assert localizer.localize_features(exact.features["004.png"], camera()).references == kept


def test_the_order_of_the_keypoints_does_not_matter(exact, options):
    localizer, of_image = Localizer(exact, options), exact.features["002.png"]
    of_image = replace(of_image, scores=np.linspace(1, 2, len(of_image), dtype=np.float32))
    order = np.random.default_rng(0).permutation(len(of_image))
    one, other = (localizer.localize_features(f, camera()) for f in (of_image, of_image[order]))
    assert np.array_equal(one.points2D, other.points2D)
    assert np.array_equal(one.pose.cam_from_world.matrix(), other.pose.cam_from_world.matrix())


def test_a_query_does_not_change_while_another_is_localized(exact, options):
    localizer, one = Localizer(exact, options), exact.features["002.png"]
    other = one[np.arange(len(one))[::-1]]
    alone = list(localizer.rounds(one, camera()))
    interrupted = []
    for result in localizer.rounds(one, camera()):
        interrupted.append(result)
        localizer.localize_features(other, camera())
    assert len(alone) == len(interrupted)
    for a, b in zip(alone, interrupted, strict=True):
        assert np.array_equal(a.matches.keypoints, b.matches.keypoints)
        assert np.array_equal(a.matches.points, b.matches.points)


def test_a_localizer_serves_several_threads(exact, options):
    localizer = Localizer(exact, options)
    queries = 4 * list(exact.features.values())
    alone = [localizer.localize_features(query, camera()) for query in queries]
    with ThreadPoolExecutor(4) as executor:
        together = list(executor.map(lambda query: localizer.localize_features(query, camera()), queries))
    for a, b in zip(alone, together, strict=True):
        assert np.array_equal(a.pose.cam_from_world.matrix(), b.pose.cam_from_world.matrix())
        assert a.pose.confidence == b.pose.confidence


def strategy_of(map_: Map, options: LocalizationOptions) -> Strategy:
    return load_strategy(options.strategy, map_, MatchingOptions(retrieved=len(map_.images)))


@given(st.lists(arrays(np.int64, st.tuples(st.integers(0, 5), st.just(2)), elements=st.integers(0, 3))))
def test_uniting_is_the_union_of_sets(parts):
    matches = unite([PointMatches(keypoints=part[:, 0], points=part[:, 1]) for part in parts])
    united = sorted({tuple(row) for part in parts for row in part.tolist()})
    assert list(zip(matches.keypoints.tolist(), matches.points.tolist(), strict=True)) == united


def test_an_unknown_strategy_is_refused_by_name():
    known = ", ".join(sorted(STRATEGIES))
    with pytest.raises(ValueError, match=re.escape(f"strategy must be auto or one of {known}, got 'guess'")):
        LocalizationOptions(strategy="guess")


def test_auto_matches_points_directly_if_the_map_has_chosen_points(exact):
    options = LocalizationOptions()
    assert options.strategy == "auto"
    assert options.strategy_for(exact) == "progressive"
    chosen = describe_points(exact)
    for map_ in (direct_map(exact, chosen), with_points(exact, exact, chosen)):
        assert options.strategy_for(map_) == "direct"
        assert LocalizationOptions(strategy="exhaustive").strategy_for(map_) == "exhaustive"
    assert LocalizationOptions(strategy="direct").strategy_for(exact) == "direct"
