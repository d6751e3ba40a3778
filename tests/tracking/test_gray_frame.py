import numpy as np
import pytest

from pictures import cloth, grid, moved
from slimsfm.tracking.templates import follow_points


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.7), (5.3, 2.6), (-14.0, 9.5)], ids=str)
def test_flow_recovers_a_known_translation(shift):
    points = grid()
    flow = follow_points(cloth(), moved(cloth(), *shift), points, points)
    assert flow.found.mean() > 0.95
    errors = np.linalg.norm(flow.points2D - points - shift, axis=1)[flow.found]
    assert np.quantile(errors, 0.95) < 0.1


def test_good_guess_compensates_for_large_motion():
    points, shift = grid(), np.array([50.0, -40.0])
    flow = follow_points(cloth(), moved(cloth(), *shift), points, points + shift + (3.0, -2.0))
    errors = np.linalg.norm(flow.points2D - points - shift, axis=1)
    assert np.quantile(errors[flow.found], 0.95) < 0.1
    assert flow.found.mean() > 0.95


@pytest.mark.parametrize("guess", [-30.0, 1000.0, np.nan, np.inf])
def test_point_with_a_guess_outside_the_image_is_not_found(guess):
    points = grid()
    guesses = points.copy()
    guesses[::2, 0] = guess
    found = follow_points(cloth(), cloth(), points, guesses).found
    assert not found[::2].any()
    assert found[1::2].all()


def test_no_points_give_empty_flow():
    none = np.zeros((0, 2))
    flow = follow_points(cloth(), cloth(), none, none)
    assert (flow.points2D.shape, flow.found.shape) == ((0, 2), (0,))
