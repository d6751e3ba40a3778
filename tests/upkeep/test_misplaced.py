from dataclasses import replace

import numpy as np
import pytest

from slimsfm.mapping.support import agreement, measure
from slimsfm.progress import silent
from slimsfm.upkeep import misplaced as module
from slimsfm.upkeep.checking import check, wrong_poses
from slimsfm.upkeep.findings import Misplaced
from slimsfm.upkeep.misplaced import Surroundings
from slimsfm.upkeep.repair import repair
from wrong_poses import laid_over, matched_map, turned

PART = tuple(f"{number:03d}.png" for number in range(25, 32))
"""Images that are laid over those on the other side."""


@pytest.fixture(scope="module")
def right():
    return matched_map(36, 200)


@pytest.fixture(scope="module")
def folded(right):
    return laid_over(right, PART, 180)


def misplaced(map_, wrong=()):
    found = Surroundings(map_, map_.matches, agreement(map_.images, map_.matches)).misplaced(wrong)
    return tuple(one.name for one in found)


def test_a_right_map_has_no_misplaced_images(right):
    assert misplaced(right) == ()


def test_images_that_were_laid_over_others_are_misplaced(folded):
    assert misplaced(folded) == PART


def test_what_is_known_to_be_wrong_is_not_named_again(folded):
    assert misplaced(folded, wrong=PART[:3]) == PART[3:]


def test_an_image_that_something_hides_from_the_others_is_not_misplaced(right):
    thin = {
        pair: rows[:: 1 + 9 * ("010.png" in pair)] for pair, rows in right.matches.items()
    }  # it matches few points, but they agree
    assert misplaced(replace(right, matches=thin)) == ()


def test_few_images_with_look_alike_matches_are_right():
    """Images of wide steps should see nothing in common from nearly the same place."""
    few = matched_map(12, 200)
    rows = np.stack([np.arange(20)] * 2, axis=1)
    assert misplaced(replace(few, matches={**few.matches, ("001.png", "007.png"): rows})) == ()


def test_parts_are_cut_where_the_sums_over_all_pairs_say(folded):
    """What the tree adds up for its edges are the sums over the pairs that an edge separates."""
    agreeing = agreement(folded.images, folded.matches)
    pairs = module._pairs(folded, folded.matches, agreeing, silent)
    kept = np.ones(len(folded.images), bool)
    kept[3] = False
    tree = module._spanning_tree(pairs, kept)
    across = module._across(pairs, kept, tree)
    assert len(tree.order) > 30
    for top, sums in zip(tree.order, across, strict=True):
        side = np.isin(np.arange(len(kept)), list(tree.smaller_side(top)))
        a, b = pairs.images.T
        separated = side[a] & ~side[b] & kept[b]
        np.testing.assert_allclose(sums, [weight[separated].sum() for weight in pairs.weights], atol=1e-6)


def test_a_check_names_all_images_of_a_fold_and_a_repair_leaves_a_right_map(folded):
    found = check(folded)
    assert found.wrong_names == PART
    assert tuple(one.name for one in wrong_poses(folded)) == PART
    repaired = repair(folded, found)
    assert {*repaired.moved, *repaired.dropped} == set(PART)
    assert not check(repaired.map).is_contradicted


def test_images_that_no_others_localize_are_dropped(folded):
    rng = np.random.default_rng(0)
    matches = dict(folded.matches)
    for pair in [pair for pair in matches if len(set(pair) & set(PART)) == 1]:
        rows = matches[pair].copy()
        matches[pair] = np.stack([rows[:, 0], rng.permutation(rows[:, 1])], axis=1)  # of look-alikes
    lost = replace(folded, matches=matches)
    found = check(lost)
    assert tuple(one.name for one in found.misplaced) == PART
    assert "contradict" in found.misplaced[0].sentence
    repaired = repair(lost, found)
    assert (repaired.moved, repaired.dropped) == ((), PART)
    assert not set(PART) & set(repaired.map.images)


def test_look_alikes_in_a_right_map_are_not_blamed(right):
    """Most pairs contradict the map, as in a room with a patterned carpet, but neighbors agree with it."""
    rng = np.random.default_rng(0)
    matches, names = {}, list(right.images)
    for (a, b), rows in right.matches.items():
        is_near = (names.index(b) - names.index(a)) % len(names) in (1, len(names) - 1)
        matches[a, b] = rows if is_near else np.stack([rows[:, 0], rng.permutation(rows[:, 1])], axis=1)
    assert misplaced(replace(right, matches=matches)) == ()


def test_given_poses_are_believed_more_than_matches(folded):
    quality = measure(folded.model, folded.matches, folded.images)
    given = replace(quality, focal_origins={"001.png": "given"})
    assert not check(replace(folded, info=replace(folded.info, quality=given))).misplaced


def test_known_poses_stay_known_when_the_first_image_is_dropped(right):
    few = replace(right, matches={p: rows for p, rows in right.matches.items() if "001.png" not in p})
    few = replace(few, matches={**few.matches, ("001.png", "002.png"): right.matches["001.png", "002.png"]})
    quality = measure(few.model, few.matches, few.images).with_origins({"001.png": "given"})
    wrong = turned(replace(few, info=replace(few.info, quality=quality)), "001.png", 60)
    repaired = repair(wrong, check(wrong))
    assert repaired.dropped == ("001.png",)
    assert repaired.map.info.quality.has_known_poses


def test_references_that_are_misplaced_set_nothing_right(right):
    wrong = turned(right, "004.png", 30)
    found = check(wrong)
    unreliable = found.wrong[0].sets[0][0]
    misled = replace(
        found, misplaced=(Misplaced(name=unreliable, expected=1, seen=0, matches=1, agreeing=0.0),)
    )
    assert repair(wrong, misled).dropped == tuple(sorted(["004.png", unreliable]))
