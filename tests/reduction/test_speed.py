"""Speeds are measured on images that are in neither map, and both baselines are named."""

import numpy as np
import pytest

from scenes import exact_map
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping.subset import direct_map, keep_images
from slimsfm.reduction import measure_speed


@pytest.fixture(scope="module")
def full():
    return exact_map(12, 200)


def test_points_are_compared_with_both_ways_to_match_the_full_map(full):
    found = measure_speed(full, direct_map(full, describe_points(full)[np.arange(60)]))
    assert found.strategy == "progressive"
    assert found.tests == len(full.images) // 4
    for one in (found.slim, found.exhaustive, found.default):
        assert min(one.extract, one.match, one.pose) > 0


def test_images_that_are_kept_are_no_queries(full):
    names = list(full.images)
    assert measure_speed(full, keep_images(full, names[:10])).tests == 2
    assert measure_speed(full, full) is None
