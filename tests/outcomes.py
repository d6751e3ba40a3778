"""Compares outcomes of localization."""

import numpy as np


def assert_same_outcomes(some, others):
    assert list(some) == list(others)
    for name, one in some.items():
        other = others[name]
        assert (one.pose is None) == (other.pose is None)
        assert np.array_equal(one.points2D, other.points2D)
        if one.pose:
            assert np.array_equal(one.pose.cam_from_world.matrix(), other.pose.cam_from_world.matrix())
