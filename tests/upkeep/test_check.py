from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from slimsfm.errors import MapError
from slimsfm.features import Features
from slimsfm.geometry import corner_error
from slimsfm.graph import ReferenceGraph
from slimsfm.mapping import read_map, write_map
from slimsfm.mapping.subset import keep_images
from slimsfm.mapping.support import measure
from slimsfm.reduction import DominatingSetOptions, dominating_set
from slimsfm.upkeep.checking import check
from slimsfm.upkeep.likeness import find_duplicates
from slimsfm.upkeep.repair import repair
from wrong_poses import matched_map, swapped, turned, with_poses


@pytest.fixture(scope="module")
def right():
    return matched_map()


def test_a_right_map_has_no_findings(right):
    found = check(right)
    nothing = found.wrong, found.unlocalized, found.duplicates, found.blurred, found.threads
    assert nothing == ((), (), (), (), ())
    assert not found.is_contradicted
    assert found.usual_error < 1e-6
    assert (found.images, found.matches_from) == (12, "map")


@pytest.mark.parametrize("angle_deg", [-90, -5, 5, 20, 180])
def test_a_moved_image_and_no_other_is_wrong(right, angle_deg):
    found = check(turned(right, "004.png", angle_deg))
    assert found.wrong_names == ("004.png",)


@pytest.mark.parametrize(("a", "b"), [("001.png", "002.png"), ("003.png", "010.png")])
def test_two_images_with_each_others_poses_are_wrong(right, a, b):
    assert check(swapped(right, a, b)).wrong_names == (a, b)


def test_the_others_say_where_a_wrong_image_stands(right):
    (one,) = check(turned(right, "004.png", 30)).wrong
    true = right.images["004.png"].cam_from_world()
    assert corner_error(one.others_cam_from_world, true, right.box) < 1e-6
    assert one.rotation_deg == pytest.approx(30, abs=1e-3)
    assert one.distance == pytest.approx(corner_error(one.cam_from_world, true, right.box), rel=1e-3)
    assert len(one.sets) == 3
    assert not set(one.sets[0]) & set(one.sets[1])
    assert "004.png" not in {name for some in one.sets for name in some}


def test_pictures_beside_wrong_ones_are_not_blamed(right):
    wrong = turned(turned(turned(right, "003.png", 60), "004.png", -50), "005.png", 40)
    assert check(wrong).wrong_names == ("003.png", "004.png", "005.png")


def test_images_that_were_misplaced_together_are_found_together(right):
    names = ["003.png", "004.png", "005.png", "006.png"]
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.0, 1.2])), np.zeros(3))
    poses = {name: right.images[name].cam_from_world() * turn for name in names}
    assert check(with_poses(right, poses)).wrong_names == tuple(names)


def test_equal_maps_have_equal_findings(right):
    wrong = swapped(right, "001.png", "009.png")
    assert [one.sentence for one in check(wrong).wrong] == [one.sentence for one in check(wrong).wrong]


def test_a_map_without_matches_is_matched_again(right):
    found = check(replace(turned(right, "004.png", 30), matches={}))
    assert (found.wrong_names, found.matches_from) == (("004.png",), "matched again")


def test_a_map_without_matches_and_keypoints_is_refused(right):
    with pytest.raises(MapError, match="no matches, and extractor 'loftr' no keypoints"):
        check(replace(right, matches={}, info=replace(right.info, extractor="loftr")))


def test_a_reduced_map_is_refused_with_what_to_check_instead(right):
    with pytest.raises(MapError, match="check the map that it was reduced from"):
        check(keep_images(right, ["001.png", "002.png"]))


def test_an_image_without_matches_is_not_localized(right):
    matches = {pair: rows for pair, rows in right.matches.items() if "004.png" not in pair}
    (one,) = check(replace(right, matches=matches)).unlocalized
    assert (one.name, one.references, one.matches) == ("004.png", 0, 0)


def test_two_images_of_equal_pixels_are_duplicates(right):
    a, b = "004.png", "005.png"
    count = min(len(right.features[name]) for name in (a, b))
    features = {**right.features, b: right.features[a]}
    pairs = np.stack([np.arange(count)] * 2, axis=1)
    (one,) = find_duplicates(replace(right, features=features), {(a, b): pairs})
    assert (one.name, one.copy, one.matched, one.moved_px) == (a, b, 1.0, 0.0)
    assert "poses are" in one.sentence  # although the pixels are equal


def test_a_pair_of_neighbors_that_contradicts_the_map_is_a_fold(right):
    pair = "004.png", "005.png"
    rows = right.matches[pair].copy()
    rows[:, 1] = np.roll(rows[:, 1], 1)
    folded = replace(right, matches={**right.matches, pair: rows})
    found = check(folded)
    assert not found.wrong
    assert found.is_contradicted
    (one,) = found.contradicted_pairs
    assert ((one.first, one.second), one.matches) == (pair, len(rows))
    assert one.agreeing < 0.3
    given = replace(
        right.info,
        quality=replace(
            measure(right.model, right.matches, right.images), focal_origins={"001.png": "given"}
        ),
    )
    assert not check(replace(folded, info=given)).contradicted_pairs  # known poses are believed more


def test_an_image_without_small_keypoints_is_blurred(right):
    rng = np.random.default_rng(0)

    def with_scales(features: Features, least: float) -> Features:
        scales = np.maximum(rng.uniform(1, 10, len(features)), least)
        return replace(features, frames=np.stack([scales, 0 * scales], axis=1).astype(np.float32))

    scaled = {
        name: with_scales(one, 6.0 if name == "004.png" else 1.0) for name, one in right.features.items()
    }
    (one,) = check(replace(right, features=scaled)).blurred
    assert (one.name, one.measured_by) == ("004.png", "features")
    assert one.sharpness < 0.1


def test_a_few_matches_between_two_halves_are_a_thread(right):
    halves = [{f"{i:03d}.png" for i in some} for some in (range(1, 7), range(7, 13))]
    matches = {
        pair: rows if any(half >= set(pair) for half in halves) else rows[:3]
        for pair, rows in right.matches.items()
    }
    (one,) = check(replace(right, matches=matches)).threads
    assert set(one.part) in halves
    assert (one.rest, one.matches) == (6, 3)
    assert one.usual > 20


def test_repair_sets_wrong_images_right_and_leaves_all_others(right):
    wrong = turned(swapped(right, "001.png", "009.png"), "004.png", 30)
    repaired = repair(wrong, check(wrong))
    assert (repaired.moved, repaired.dropped) == (("001.png", "004.png", "009.png"), ())
    for name, image in repaired.map.images.items():
        is_pose = image.cam_from_world()
        if name in repaired.moved:
            assert corner_error(is_pose, right.images[name].cam_from_world(), right.box) < 1e-6
            assert len(repaired.map.observations[name].rows) > 30
        else:
            assert is_pose.matrix().tobytes() == wrong.images[name].cam_from_world().matrix().tobytes()
    assert not check(repaired.map).wrong
    assert "3 wrong poses were set right" in repaired.map.info.notes[-1]
    assert repaired.map.images["004.png"].image_id == right.images["004.png"].image_id


def test_repair_drops_what_one_set_of_references_alone_localizes(right):
    kept = {("003.png", "004.png")}  # the only pair of the image
    matches = {p: rows for p, rows in right.matches.items() if "004.png" not in p or p in kept}
    wrong = turned(replace(right, matches=matches), "004.png", 30)
    repaired = repair(wrong, check(wrong))
    assert (repaired.moved, repaired.dropped) == ((), ("004.png",))
    assert "004.png" not in repaired.map.images
    assert "left out: 004.png" in repaired.map.info.notes[-1]


def test_nothing_to_repair_gives_the_map_itself(right):
    assert repair(right, check(right)).map is right


def test_findings_of_another_map_are_refused(right):
    found = check(turned(right, "012.png", 30))
    with pytest.raises(ValueError, match=r"no image '012.png'"):
        repair(matched_map(8), found)


def test_marks_survive_writing_and_old_maps_have_none(right, tmp_path):
    marked = replace(right, info=replace(right.info, wrong_poses=("004.png",)))
    write_map(marked, tmp_path / "marked")
    write_map(right, tmp_path / "plain")
    assert read_map(tmp_path / "marked").info.wrong_poses == ("004.png",)
    assert "wrong_poses" not in (tmp_path / "plain" / "map.json").read_text()


def test_a_dominating_set_does_not_pay_for_wrong_poses(right):
    names = tuple(right.images)
    pairs = np.argwhere(~np.eye(12, dtype=bool))
    near = (pairs != 3).all(axis=1)  # image 4 localizes no other, and none localizes it
    graph = ReferenceGraph.from_errors(names, pairs, np.where(near, 0.01, np.inf))
    marked = replace(right, info=replace(right.info, wrong_poses=(names[3],)))
    assert len(dominating_set(graph, DominatingSetOptions(), right).chosen) == 2
    assert len(dominating_set(graph, DominatingSetOptions(), marked).chosen) == 1
    assert 3 not in dominating_set(graph, DominatingSetOptions(), marked).chosen


def test_a_map_whose_poses_are_all_wrong_ends(right):
    rng = np.random.default_rng(0)
    poses = [image.cam_from_world() for image in right.images.values()]
    shuffled = [poses[i] for i in rng.permutation(len(poses))]
    found = check(with_poses(right, dict(zip(right.images, shuffled, strict=True))))
    assert len(found.wrong) + len(found.unlocalized) > 0
