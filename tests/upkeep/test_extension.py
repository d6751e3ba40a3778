from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from slimsfm.errors import MapError
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import check_map
from slimsfm.mapping.subset import keep_images
from slimsfm.upkeep.extension import JoinedMapping, NewImage, extend_map
from wrong_poses import matched_map

TAKEN = "003.png", "006.png"


@pytest.fixture(scope="module")
def full():
    """Every pair of images is matched as its tracks say."""
    return matched_map(8, 150)


def without(map_, names):
    return keep_images(map_, set(map_.images) - set(names), min_track_length=2)


def new_image(map_, name, **changes):
    image = map_.images[name]
    values = {
        "features": map_.features[name],
        "camera": map_.camera(name),
        "cam_from_world": image.cam_from_world(),
        "image_id": image.image_id,
    }
    return NewImage(**(values | changes))


def put_back(map_, names=TAKEN, **changes):
    matches = {pair: map_.matches[pair] for pair in map_.matches if set(pair) & set(names)}
    new = {name: new_image(map_, name, **changes) for name in names}
    return extend_map(without(map_, names), new, matches)


def observations(map_, name):
    """Keypoints that see a point of three images or more: COLMAP makes no points of two views alone."""
    seen = map_.observations[name]
    lengths = [map_.model.point3D(i).track.length() for i in map_.point3D_ids[seen.points].tolist()]
    return seen.rows[np.array(lengths) >= 3].tolist()


def moved(pose, by=0.01):
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.full(3, by)), np.full(3, by)) * pose


def test_an_image_that_was_taken_out_is_put_back(full):
    extended = put_back(full)
    check_map(extended)
    assert extended.model.is_valid()
    assert list(extended.images) == list(full.images)
    assert set(extended.matches) == set(full.matches)
    for name in full.images:
        assert extended.images[name].image_id == full.images[name].image_id
        assert set(observations(extended, name)) >= set(observations(full, name))


def test_old_parts_keep_every_bit(full):
    before = without(full, TAKEN)
    extended = put_back(
        full, cam_from_world=moved(full.images["003.png"].cam_from_world()), names=["003.png"]
    )
    before = without(full, ["003.png"])
    for name, image in before.images.items():
        after = extended.images[name]
        assert np.array_equal(after.cam_from_world().matrix(), image.cam_from_world().matrix())
        assert (after.image_id, after.camera_id, after.frame_id) == (
            image.image_id,
            image.camera_id,
            image.frame_id,
        )
        assert repr(extended.camera(name)) == repr(before.camera(name))
        seen, now = before.observations[name], extended.observations[name]
        assert set(before.point3D_ids[seen.points]) <= set(extended.point3D_ids[now.points])
    for i in before.point3D_ids.tolist():
        assert np.array_equal(extended.model.point3D(i).xyz, before.model.point3D(i).xyz)
        assert np.array_equal(extended.model.point3D(i).color, before.model.point3D(i).color)


def test_a_pose_that_is_a_little_off_is_adjusted(full):
    name = TAKEN[0]
    true = full.images[name].cam_from_world()
    extended = put_back(full, [name], cam_from_world=moved(true))
    assert extended.images[name].cam_from_world().matrix() == pytest.approx(true.matrix(), abs=1e-5)


def test_features_of_a_larger_image_may_be_off_by_more_pixels(full):
    """Limits are for the pixels in which features were found: the errors of shrunk images are enlarged."""
    shrinking = replace(full, info=replace(full.info, extractor_options={"max_image_size": 64}))
    off = full.features["003.png"]
    shifts = np.resize(np.array([[12, 0], [-12, 0]], np.float32), (len(off), 2))
    off = replace(off, keypoints=off.keypoints + shifts)
    few, many = (
        len(put_back(one, ["003.png"], features=off).observations["003.png"].rows)
        for one in (full, shrinking)
    )
    assert many > 2 * few


def test_wrong_matches_become_no_observations(full):
    matches = {pair: full.matches[pair] for pair in full.matches if "003.png" in pair}
    rng = np.random.default_rng(0)
    wrong = {pair: np.stack([one[:, 0], rng.permutation(one[:, 1])], axis=1) for pair, one in matches.items()}
    extended = extend_map(without(full, ["003.png"]), {"003.png": new_image(full, "003.png")}, wrong)
    assert len(extended.observations["003.png"].rows) < 0.2 * len(full.observations["003.png"].rows)


def test_new_images_get_ids_and_cameras_after_the_old_ones(full):
    other = pycolmap.Camera(full.camera("003.png").todict())
    other.camera_id = 7
    extended = put_back(full, image_id=None, camera=other)
    assert [extended.images[name].image_id for name in TAKEN] == [9, 10]
    assert [extended.images[name].camera_id for name in TAKEN] == [7, 7]


def test_new_points_are_colored_by_the_new_images(full):
    colors = np.full((len(full.features["003.png"]), 3), (1, 2, 3), np.uint8)
    only = [i for i in full.point3D_ids.tolist() if full.model.point3D(i).track.length() >= 2]
    names = list(full.images)[2:5]
    matches = {pair: full.matches[pair] for pair in full.matches if set(pair) & set(names)}
    before = without(full, names)
    extended = extend_map(before, {n: new_image(full, n, colors=colors) for n in names}, matches)
    made = set(extended.point3D_ids.tolist()) - set(before.point3D_ids.tolist())
    assert made
    assert len(only) >= len(extended.point3D_ids)
    assert {tuple(extended.model.point3D(i).color) for i in made} == {(1, 2, 3)}


def test_the_same_input_gives_the_same_bytes(full, tmp_path):
    for name in ("a", "b"):
        write_map(put_back(full), tmp_path / name)
    for path in sorted(p for p in (tmp_path / "a").rglob("*") if p.is_file()):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()
    assert read_map(tmp_path / "a").fingerprint == read_map(tmp_path / "b").fingerprint


def test_wrong_arguments_are_named(full):
    with pytest.raises(ValueError, match="in the map"):
        extend_map(full, {"003.png": new_image(full, "003.png")}, {})
    with pytest.raises(ValueError, match="at least one"):
        extend_map(full, {}, {})
    before = without(full, ["003.png"])
    with pytest.raises(ValueError, match="matches"):
        extend_map(
            before,
            {"003.png": new_image(full, "003.png")},
            {("001.png", "002.png"): np.zeros((0, 2), np.int64)},
        )
    with pytest.raises(MapError, match="full map"):
        extend_map(replace(before, info=replace(before.info, extractor="loftr")), {}, {})


def test_joined_mappings_are_sorted_and_the_second_one_has_precedence():
    joined = JoinedMapping({"b": 1, "c": 2}, {"a": 3, "c": 4})
    assert dict(joined) == {"a": 3, "b": 1, "c": 4}
    assert list(joined) == ["a", "b", "c"]
    assert len(joined) == 3
    assert "d" not in joined
