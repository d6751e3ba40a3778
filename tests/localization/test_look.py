from itertools import pairwise

import numpy as np
import pytest

from slimsfm.methods.onepose.crop import Look, Region
from slimsfm.tracking.templates import Sighting, find, spread


def look(*points: int, at: float) -> Look:
    return Look(np.array(points, np.int64), np.full((len(points), 2), at))


def test_points_are_where_the_later_look_finds_them():
    both = look(5, 2, at=9.0).added_to(look(1, 2, 3, at=4.0))
    assert dict(zip(both.points.tolist(), both.points2D[:, 0].tolist(), strict=True)) == {
        5: 9.0,
        2: 9.0,
        1: 4.0,
        3: 4.0,
    }
    matches = both.matches(references=3)
    assert matches.points2D is both.points2D
    assert np.array_equal(matches.keypoints, np.arange(4))
    assert matches.references == 3


@pytest.mark.parametrize("count", [0, 1, 2, 15, 16, 400])
def test_images_to_ask_are_spread_evenly(count):
    rows = spread(count)
    assert len(rows) == min(count, 15)
    assert set(rows) <= set(range(count))
    gaps = [b - a for a, b in pairwise(rows)]
    assert not gaps or 1 <= min(gaps) >= max(gaps) - 1


def test_images_are_asked_until_one_is_sure():
    regions = [Region(left=float(n), top=0.0, right=99.0, bottom=99.0) for n in range(4)]
    told = [None, *(Sighting(region=regions[n], inliers=n_in) for n, n_in in enumerate((20, 40, 80, 200)))]
    asked = iter(told)
    found = find(asked)
    assert found.region == regions[2]
    assert found.references == 4
    assert len(list(asked)) == 1
    assert find(told[:3]) == (regions[1], 3)
    assert find([]) == (None, 0)
