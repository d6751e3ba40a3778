"""Merging maps: two halves of an exact scene give the scene, in whatever frames they are."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from commands import slimsfm
from scenes import exact_map, with_matches
from slimsfm.errors import InputError, MapError
from slimsfm.geometry import corner_error
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import check_map
from slimsfm.mapping.subset import keep_images
from slimsfm.mapping.support import measure
from slimsfm.upkeep.merge import merge
from slimsfm.upkeep.transform import transformed

OTHER_FRAME = pycolmap.Sim3d(0.4, pycolmap.Rotation3d(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2.0, -3.0]))


@pytest.fixture(scope="module")
def full():
    return with_matches(exact_map(12, 200, reach_deg=80))


def part(map_, names):
    return keep_images(map_, names, min_track_length=2)


@pytest.fixture(scope="module")
def halves(full):
    """Two maps in different frames that share four images."""
    names = list(full.images)
    return part(full, names[:8]), transformed(part(full, names[4:]), OTHER_FRAME)


@pytest.fixture(scope="module")
def merged(halves):
    return merge(*halves)


def test_halves_that_share_images_give_the_whole(full, halves, merged):
    check_map(merged.map)
    assert merged.map.model.is_valid()
    assert merged.kept == 0
    assert list(merged.map.images) == list(full.images)
    assert merged.shared == tuple(list(full.images)[4:8])
    assert merged.joined_points > 50
    for name, image in full.images.items():
        assert corner_error(merged.map.images[name].cam_from_world(), image.cam_from_world(), full.box) < 1e-6
    assert set(halves[0].matches) | set(halves[1].matches) <= set(merged.map.matches)
    assert merged.map.info.origin.startswith("merged from")


def with_origin(map_, origin):
    """The map with a quality, whose focal lengths have an origin."""
    quality = measure(map_.model, map_.matches, map_.images)
    origins = dict.fromkeys(quality.focal_lengths, origin)
    return replace(map_, info=replace(map_.info, quality=quality.with_origins(origins)))


@pytest.mark.parametrize(
    ("first", "second", "known"),
    [("given", "given", True), ("given", "EXIF", True), ("EXIF", "given", False), ("EXIF", "EXIF", False)],
)
def test_poses_are_known_if_those_are_whose_frame_is_kept(halves, first, second, known):
    """Known poses are believed more than matches of what looks alike."""
    made = merge(with_origin(halves[0], first), with_origin(halves[1], second)).map
    assert made.info.quality.has_known_poses == known
    assert set(made.info.quality.focal_origins.values()) == {first}


def test_photos_that_neither_map_has_are_counted_once(halves, full):
    lacking = [
        replace(with_origin(half, "EXIF"), unregistered=(*(full.images.keys() - half.images.keys()), "x.png"))
        for half in halves
    ]
    made = merge(*lacking).map
    assert made.unregistered == ("x.png",)
    assert (made.info.quality.given, made.info.quality.registered) == (13, 12)


def test_no_point_is_there_twice(merged):
    points = merged.map.points3D_in_world
    assert len(np.unique(points.round(4), axis=0)) == len(points)


def test_what_the_first_map_has_does_not_move(halves, merged):
    first = halves[0]
    for name, image in first.images.items():
        kept = merged.map.images[name]
        assert kept.image_id == image.image_id
        assert np.array_equal(kept.cam_from_world().matrix(), image.cam_from_world().matrix())
    for point_id in first.point3D_ids.tolist():
        assert np.array_equal(merged.map.model.point3D(point_id).xyz, first.model.point3D(point_id).xyz)


def test_images_are_localized_where_none_is_shared(full):
    names = list(full.images)
    found = merge(part(full, names[::2]), transformed(part(full, names[1::2]), OTHER_FRAME))
    assert found.shared == ()
    assert list(found.map.images) == names
    assert any((a in names[::2]) != (b in names[::2]) for a, b in found.map.matches)
    for name, image in full.images.items():
        assert corner_error(found.map.images[name].cam_from_world(), image.cam_from_world(), full.box) < 0.01


def test_the_frame_is_that_of_the_map_that_knows_its_unit(halves):
    first, second = halves
    found = merge(replace(first, info=replace(first.info, unit="unknown")), second)
    assert found.kept == 1
    assert found.map.info.unit == "metre"
    name = next(iter(second.images))
    pose = second.images[name].cam_from_world()
    assert np.array_equal(found.map.images[name].cam_from_world().matrix(), pose.matrix())


def test_other_photos_of_equal_names_are_renamed(full):
    names = list(full.images)
    second = part(full, names[1::2])
    model = pycolmap.Reconstruction(second.model)
    taken = dict(zip(names[1::2], names[::2], strict=True))
    for image in model.images.values():
        image.name = taken[image.name]
    features = {taken[name]: second.features[name] for name in second.images}
    renamed = replace(second, model=model, features=features, matches={}, global_descriptors=None)
    found = merge(part(full, names[::2]), renamed)
    assert found.names == {name: f"other/{name}" for name in names[::2]}
    assert len(found.map.images) == len(names)


def test_merging_is_deterministic_and_survives_the_disk(halves, merged, tmp_path):
    again = merge(*halves).map
    assert again.fingerprint == merged.map.fingerprint
    write_map(again, tmp_path / "merged")
    assert read_map(tmp_path / "merged").fingerprint == again.fingerprint


def test_refining_says_how_far_images_moved(halves):
    found = merge(*halves, refine=True)
    assert found.movement is not None
    assert found.movement.largest < 1e-3


def test_two_places_are_refused(full):
    elsewhere = with_matches(exact_map(6, 200, seed=5, reach_deg=80))
    model = pycolmap.Reconstruction(elsewhere.model)
    for image in model.images.values():
        image.name = f"elsewhere-{image.name}"
    features = {f"elsewhere-{name}": elsewhere.features[name] for name in elsewhere.images}
    other = replace(elsewhere, model=model, features=features, matches={}, global_descriptors=None)
    with pytest.raises(InputError, match="maps that show the same place"):
        merge(full, other)


def test_an_overlap_that_contradicts_itself_is_refused(full):
    names = list(full.images)
    second = part(full, names[4:])
    model = pycolmap.Reconstruction(second.model)
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.0, 0.5])), np.zeros(3))
    for number, name in enumerate(names[4:8]):
        frame = model.frame(second.images[name].frame_id)
        frame.rig_from_world = (
            pycolmap.Rigid3d(turn.rotation, np.full(3, 0.1 * number)) * frame.rig_from_world
        )
    with pytest.raises(InputError, match="contradict"):
        merge(part(full, names[:8]), replace(second, model=model))


def test_reduced_maps_foreign_features_and_the_same_map_are_refused(full, halves):
    first, second = halves
    with pytest.raises(MapError, match="second map was reduced"):
        merge(first, keep_images(second, list(second.images)[:2]))
    foreign = replace(second, info=replace(second.info, extractor_options={"max_features": 7}))
    with pytest.raises(MapError, match="max_features"):
        merge(first, foreign)
    with pytest.raises(InputError, match="same map"):
        merge(full, full)


def test_the_command_merges_and_refuses(halves, tmp_path):
    for name, map_ in zip(("first", "second"), halves, strict=True):
        write_map(map_, tmp_path / name)
    done = slimsfm("merge", tmp_path / "first", tmp_path / "second", "-o", tmp_path / "merged")
    assert done.code == 0
    assert "4 photos in both maps" in done.out
    assert len(read_map(tmp_path / "merged").images) == 12
    refused = slimsfm("merge", tmp_path / "first", tmp_path / "first", "-o", tmp_path / "twice")
    assert refused.code == 2
    assert "same map" in refused.err
    assert not (tmp_path / "twice").exists()
