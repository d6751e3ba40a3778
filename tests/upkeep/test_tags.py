"""The scale by printed tags, of photos whose poses are exact."""

import numpy as np
import pycolmap
import pytest
from tagged import photograph

from scenes import exact_map
from slimsfm.errors import InputError
from slimsfm.upkeep.align import Tag, align
from slimsfm.upkeep.transform import transformed

SIDE = 1.2  # map units of the tags
HERE, THERE = np.array([-0.9, 0.0, 0.3]), np.array([1.0, 0.5, 0.0])


@pytest.fixture(scope="module")
def map_():
    return exact_map(num_images=8)


@pytest.fixture(scope="module")
def two(map_, tmp_path_factory):
    folder = tmp_path_factory.mktemp("two")
    return photograph(folder, map_, list(map_.images), {3: (HERE, SIDE), 8: (THERE, SIDE)})


def test_tags_give_the_scale_to_a_thousandth(map_, two):
    unscaled = transformed(map_, pycolmap.Sim3d(3.7, pycolmap.Rotation3d(), np.zeros(3)))
    found = align(unscaled, Tag(images=two, side=0.12))
    assert found.new_from_old.scale == pytest.approx(0.12 / (3.7 * SIDE), rel=1e-3)
    assert found.map.info.unit == "metre"
    assert found.by == "tags 3, 8 of 0.12 m"
    assert found.inliers == found.used > 10
    assert found.median_residual is not None
    assert found.median_residual < 0.5


def test_one_of_several_tags_can_be_named(map_, two):
    found = align(map_, Tag(images=two, side=0.12, number=8))
    assert found.new_from_old.scale == pytest.approx(0.1, rel=2e-3)
    with pytest.raises(InputError, match="do not show tag 7, but 3, 8"):
        align(map_, Tag(images=two, side=0.12, number=7))


def test_tags_of_different_sizes_are_refused(map_, tmp_path):
    photograph(tmp_path, map_, list(map_.images)[:4], {3: (HERE, SIDE), 8: (THERE, 1.1 * SIDE)})
    with pytest.raises(InputError, match=r"tags 3 and 8 contradict each other.*factor of 1\.1"):
        align(map_, Tag(images=tmp_path, side=0.12))


def test_a_tag_that_was_moved_is_refused(map_, tmp_path):
    names = list(map_.images)[:6]
    for index, name in enumerate(names):
        photograph(tmp_path, map_, [name], {3: (HERE + np.array([0.25 * index, 0.1 * index**2, 0]), SIDE)})
    with pytest.raises(InputError, match="tag 3: the 6 photos that show it contradict each other"):
        align(map_, Tag(images=tmp_path, side=0.12))


def test_a_tag_in_one_photo_at_a_grazing_angle_is_refused(map_, tmp_path):
    photograph(tmp_path, map_, list(map_.images)[:1], {3: (HERE, SIDE)})
    with pytest.raises(InputError, match=r"tag 3 is seen in one photo only \(001.png, 7\d° from its face\)"):
        align(map_, Tag(images=tmp_path, side=0.12))


def test_another_family_is_named(map_, tmp_path):
    photograph(tmp_path, map_, list(map_.images)[:2], {3: (HERE, SIDE)}, "aruco-4x4")
    with pytest.raises(InputError, match=r"no tag of the family apriltag-36h11.*there are tags of aruco-4x4"):
        align(map_, Tag(images=tmp_path, side=0.12))
    found = align(map_, Tag(images=tmp_path, side=0.12, family="aruco-4x4"))
    assert found.new_from_old.scale == pytest.approx(0.1, rel=5e-3)


def test_photos_of_another_map_are_refused(map_, tmp_path):
    with pytest.raises(InputError, match="holds none of the map's 8 photos"):
        align(map_, Tag(images=tmp_path, side=0.12))


@pytest.mark.parametrize("side", [0.0, -1.0, float("nan")])
def test_an_impossible_side_is_refused(tmp_path, side):
    with pytest.raises(ValueError, match="side must be positive"):
        Tag(images=tmp_path, side=side)
