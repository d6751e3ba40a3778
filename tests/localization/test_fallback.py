"""What a reduced map cannot localize, the full map does."""

from dataclasses import replace

import numpy as np
import pytest

from slimsfm.errors import InputError
from slimsfm.geometry import Box
from slimsfm.localization import Localizer, check_same_frame, localize_failed, localize_images
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.subset import direct_map


@pytest.fixture(scope="module")
def too_small(boulder):
    """A map of so few points that no pose is found."""
    full = boulder.map
    return direct_map(full, describe_points(full)[np.arange(8)])


def test_only_images_without_a_pose_are_tried_with_the_full_map(boulder, too_small):
    full = Localizer(boulder.map)
    failed = localize_images(Localizer(too_small), boulder.queries)
    assert all(one.pose is None for one in failed.values())
    directly = localize_images(full, boulder.queries)
    found = {**failed, **dict(list(directly.items())[:2])}
    for workers in (None, 1):
        again = localize_failed(full, found, boulder.queries, workers=workers)
        assert list(again) == list(failed)[2:]
        for name, one in again.items():
            assert np.array_equal(one.points2D, directly[name].points2D)
            assert (one.pose is None) == (directly[name].pose is None)
            assert one.seconds.total > found[name].seconds.total
    assert localize_failed(full, directly, boulder.queries, progress=lambda items, _: iter(items)) == {
        name: one for name, one in directly.items() if one.pose is None
    }


def test_one_image_may_be_given_by_its_path(boulder, too_small):
    path = boulder.query.image_paths[0]
    found = localize_images(Localizer(too_small), path)
    again = localize_failed(Localizer(boulder.map), found, path)
    assert list(again) == [path.name]
    assert again[path.name].pose is not None


def test_both_maps_must_have_one_frame(boulder, too_small):
    full = boulder.map
    check_same_frame(too_small, full)
    moved = Box(full.box.center + 0.1 * full.box.diagonal, full.box.half_edges)
    with pytest.raises(InputError, match="full must be the map that the reduced one was made from"):
        check_same_frame(too_small, replace(full, info=replace(full.info, box=moved)))
