"""What supports and what contradicts a model."""

from dataclasses import asdict, replace

import numpy as np
import pycolmap
import pytest

from scenes import exact_map, with_matches
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.support import agreement, measure, pieces_of, trusted_pairs


def rows(count: int) -> np.ndarray:
    return np.tile(np.arange(count)[:, None], 2)


def test_a_neighbor_in_order_of_name_is_trusted_before_a_pair_with_more_matches():
    matches = {("1.png", "2.png"): rows(60), ("10.png", "2.png"): rows(70), ("1.png", "10.png"): rows(100)}
    assert trusted_pairs(matches, ["1.png", "2.png", "10.png"]) == {("1.png", "2.png"), ("10.png", "2.png")}


def test_a_weak_neighbor_is_not_trusted():
    matches = {("a", "b"): rows(20), ("a", "c"): rows(90), ("b", "c"): rows(80)}
    assert trusted_pairs(matches, ["a", "b", "c"]) == {("a", "c"), ("b", "c")}


def test_neighbors_count_among_all_photos_also_those_without_matches():
    matches = {("a", "c"): rows(60), ("a", "d"): rows(90), ("c", "d"): rows(90)}
    assert trusted_pairs(matches, ["a", "b", "c", "d"]) == {("a", "d"), ("c", "d")}


@pytest.fixture
def scene() -> Map:
    return with_matches(exact_map(num_images=8, reach_deg=100.0))


def test_nothing_contradicts_an_exact_model(scene):
    quality = measure(scene.model, scene.matches, scene.images)
    assert quality.verified_pairs == quality.trusted_pairs == 7
    assert quality.contradicted_pairs == 0
    assert quality.contradictions == {}
    assert quality.doubts == quality.faults == quality.warnings == ()
    assert quality.pieces == (8,)
    assert quality.focal_lengths == {"001.png": pytest.approx(502.5 / 640)}


def test_agreement_is_the_share_of_matches_near_their_epipolar_lines(scene):
    a, b = "001.png", "002.png"
    right = scene.matches[a, b]
    half = np.concatenate([right, np.stack([right[:, 0], np.roll(right[:, 1], 7)], axis=1)])
    shares = agreement(scene.images, {(a, b): half})
    assert 0.5 <= shares[a, b] < 0.7


def test_images_that_stand_elsewhere_are_contradicted_by_name_and_degree(scene):
    moved = pycolmap.Reconstruction(scene.model)
    frame = moved.frame(moved.image(4).frame_id)
    frame.rig_from_world = scene.images["008.png"].cam_from_world()
    quality = measure(moved, scene.matches, scene.images)
    assert "004.png" in quality.contradictions
    assert all(share < 0.5 for share in quality.contradictions.values())
    assert set(quality.contradictions) <= {"003.png", "004.png", "005.png"}
    assert set(quality.contradictions) <= set(quality.doubtful)
    (doubt,) = quality.doubts
    assert "004.png" in doubt
    assert "folded" in doubt


def test_images_without_common_points_are_pieces_of_which_the_largest_is_kept():
    model = exact_map(num_images=7, num_points=60).model
    for point3D_id in model.point3D_ids():
        elements = [e for e in model.point3D(point3D_id).track.elements if e.image_id > 5]
        for element in elements:
            model.delete_observation(element.image_id, element.point2D_idx)
    quality = measure(model, {}, ["001.png"])
    assert quality.pieces == (5, 1, 1)
    assert any("fall into 3 pieces" in fault for fault in quality.faults)
    assert any("may be wrong: its images fall into 3 pieces" in text for text in quality.warnings)
    assert replace(quality, focal_origins={"001.png": "given"}).warnings == ()
    (kept,) = pieces_of(model, min_images=3)
    assert kept.num_reg_images() == 5
    assert len(pieces_of(model, min_images=1)) == 3
    assert measure(kept, {}, ["001.png"]).pieces == (5,)
    assert model.num_reg_images() == 7


def test_an_impossible_focal_length_is_a_fault_that_names_the_image(scene):
    model = pycolmap.Reconstruction(scene.model)
    model.camera(1).params = [640 * 400.0, 640 * 400.0, 320, 240, 0, 0, 0, 0]
    assert any("001.png" in fault for fault in measure(model, {}, scene.images).faults)


def test_quality_and_notes_are_stored_in_the_map(scene, tmp_path):
    quality = measure(scene.model, scene.matches, scene.images)
    info = replace(scene.info, quality=replace(quality, contradictions={"001.png": 0.25}), notes=("a note",))
    write_map(replace(scene, info=info), tmp_path / "map")
    again = read_map(tmp_path / "map").info
    assert again.notes == ("a note",)
    assert again.quality is not None
    assert asdict(again.quality) == asdict(info.quality)
    assert again.quality.summary == info.quality.summary


def test_copies_of_a_photo_do_not_contradict_each_other(scene):
    model = pycolmap.Reconstruction(scene.model)
    copied = scene.images["001.png"].cam_from_world()
    model.frame(model.image(2).frame_id).rig_from_world = copied
    seen = np.arange(20)
    for row in seen:
        model.image(2).points2D[row].xy = model.image(1).points2D[row].xy
    images = {image.name: image for image in model.images.values()}
    pair = ("001.png", "002.png")
    assert agreement(images, {pair: np.stack([seen, seen], axis=1)}) == {pair: 1.0}
    assert agreement(images, {pair: np.stack([seen, np.roll(seen, 1)], axis=1)})[pair] < 0.5
