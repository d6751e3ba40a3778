"""Moving a map: a group acts on it, and everything that has a place moves along."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from scenes import like_sift
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.georeference import Georeference
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import direct_map, keep_images, with_points
from slimsfm.upkeep.transform import transformed


def similarity(seed: int, scale: float = 3.0) -> pycolmap.Sim3d:
    rng = np.random.default_rng(seed)
    rotation = pycolmap.Rotation3d(rng.normal(size=3))
    return pycolmap.Sim3d(scale, rotation, 4 * rng.normal(size=3))


def positions(map_: Map) -> np.ndarray:
    return np.array([image.projection_center() for image in map_.images.values()])


def assert_same(one: Map, other: Map) -> None:
    np.testing.assert_allclose(one.points3D_in_world, other.points3D_in_world, atol=1e-9)
    np.testing.assert_allclose(positions(one), positions(other), atol=1e-9)
    np.testing.assert_allclose(one.box.corners, other.box.corners, atol=1e-9)
    for a, b in zip(one.images.values(), other.images.values(), strict=True):
        np.testing.assert_allclose(a.cam_from_world().matrix(), b.cam_from_world().matrix(), atol=1e-9)
    if one.point_descriptors is not None:
        assert other.point_descriptors is not None
        for name in ("directions", "sizes"):
            a, b = getattr(one.point_descriptors, name), getattr(other.point_descriptors, name)
            assert (a is None) is (b is None)
            if a is not None:
                np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


@pytest.fixture(params=["full", "images", "points", "images and points"])
def any_kind(exact: Map, request) -> Map:
    full = like_sift(exact)
    if request.param == "full":
        return full
    images = keep_images(full, list(full.images)[:1])
    if request.param == "images":
        return images
    described = describe_points(full)
    return direct_map(full, described) if request.param == "points" else with_points(images, full, described)


def test_two_moves_are_the_move_that_they_compose(any_kind):
    first, second = similarity(0), similarity(1, 0.2)
    assert_same(transformed(transformed(any_kind, first), second), transformed(any_kind, second * first))


def test_a_move_can_be_undone(any_kind):
    move = similarity(2)
    moved = transformed(any_kind, move)
    assert_same(transformed(moved, move.inverse()), any_kind)
    assert moved.kind == any_kind.kind


def test_projections_stay(any_kind):
    moved = transformed(any_kind, similarity(3))
    for name, image in any_kind.images.items():
        before = image.cam_from_world() * any_kind.points3D_in_world
        after = moved.images[name].cam_from_world() * moved.points3D_in_world
        np.testing.assert_allclose(after, 3 * before, atol=1e-9)


def test_nothing_else_changes(any_kind):
    moved = transformed(any_kind, similarity(4))
    assert moved.features is any_kind.features
    assert moved.matches is any_kind.matches
    assert moved.info.unit == any_kind.info.unit
    assert list(moved.images) == list(any_kind.images)
    assert np.array_equal(moved.point3D_ids, any_kind.point3D_ids)
    for name, seen in any_kind.observations.items():
        assert np.array_equal(moved.observations[name].rows, seen.rows)
        assert np.array_equal(moved.observations[name].points, seen.points)


def test_localized_poses_move_alike(exact):
    full = like_sift(exact)
    slim = direct_map(full, describe_points(full))
    move = similarity(5)
    name = next(iter(full.images))
    for map_ in (full, slim):
        poses = [
            Localizer(one, LocalizationOptions())
            .localize_features(full.features[name], full.camera(name))
            .pose
            for one in (map_, transformed(map_, move))
        ]
        assert poses[0] is not None
        assert poses[1] is not None
        expected = move.transform_camera_world(poses[0].cam_from_world)
        np.testing.assert_allclose(poses[1].cam_from_world.matrix(), expected.matrix(), atol=1e-4)


def test_places_on_earth_stay(exact):
    place = Georeference(latitude=55.7, longitude=13.2, height=40.0)
    there = replace(exact, info=replace(exact.info, georeference=place))
    moved = transformed(there, similarity(6))
    assert moved.info.georeference is not None
    np.testing.assert_allclose(
        moved.info.georeference.wgs84_of(moved.points3D_in_world),
        place.wgs84_of(exact.points3D_in_world),
        atol=1e-7,
    )


def test_the_place_survives_the_disk(exact, tmp_path):
    place = Georeference(latitude=-33.9, longitude=151.2, height=5.0, enu_from_world=similarity(7))
    write_map(replace(exact, info=replace(exact.info, georeference=place)), tmp_path / "map")
    found = read_map(tmp_path / "map").info.georeference
    assert found is not None
    assert found.to_json() == place.to_json()


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan])
def test_what_is_no_similarity_is_refused(exact, scale):
    with pytest.raises(ValueError, match="new_from_old"):
        transformed(exact, pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.zeros(3)))
