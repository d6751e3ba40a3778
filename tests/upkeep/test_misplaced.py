from dataclasses import replace

import numpy as np
import pytest

from slimsfm.mapping.subset import keep_images
from slimsfm.mapping.support import agreement, measure
from slimsfm.upkeep.checking import check, wrong_poses
from slimsfm.upkeep.misplaced import find_misplaced
from slimsfm.upkeep.repair import repair
from wrong_poses import laid_over, matched_map

PART = tuple(f"{number:03d}.png" for number in range(25, 32))
"""Images that are laid over those on the other side."""


@pytest.fixture(scope="module")
def right():
    return matched_map(36, 200)


@pytest.fixture(scope="module")
def folded(right):
    return laid_over(right, PART, 180)


def misplaced(map_, wrong=()):
    found = find_misplaced(map_, map_.matches, agreement(map_.images, map_.matches), wrong)
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


def test_a_part_beside_all_others_is_misplaced_if_its_matches_with_them_contradict_the_map(right):
    free = [f"{number:03d}.png" for number in range(5, 16)]  # where the part is moved to
    gap = keep_images(right, [name for name in right.images if name not in free], min_track_length=2)
    gap = replace(
        gap, matches={pair: right.matches[pair] for pair in right.matches if not set(pair) & set(free)}
    )
    assert misplaced(gap) == ()
    assert misplaced(laid_over(gap, PART, 180)) == PART


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
        matches[pair] = matches[pair][:12]  # too few for a pose
        matches[pair][:, 1] = rng.permutation(matches[pair][:, 1])
    lost = replace(folded, matches=matches)
    found = check(lost)
    assert tuple(one.name for one in found.misplaced) == PART
    assert "contradict" in found.misplaced[0].sentence
    repaired = repair(lost, found)
    assert (repaired.moved, repaired.dropped) == ((), PART)
    assert not set(PART) & set(repaired.map.images)


def test_given_poses_are_believed_more_than_matches(folded):
    quality = measure(folded.model, folded.matches, folded.images)
    given = replace(quality, focal_origins={"001.png": "given"})
    assert not check(replace(folded, info=replace(folded.info, quality=given))).misplaced
