from itertools import combinations

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_problems import problem_of, problems, users

from scenes import BOX, exact_map
from slimsfm.geometry import project
from slimsfm.pose import RansacOptions, estimate_pose, rms_corner_errors
from slimsfm.selection import information
from slimsfm.selection.problem import PRIOR_SIGMA
from slimsfm.selection.selectors import InformationChoice
from slimsfm.selection.usable_points import LeftOut, selection_problem

quick = settings(deadline=None, max_examples=40)


def rows_of(problem, image, points):
    """The twists of an image's uses of the chosen points, stacked."""
    uses = range(problem.usable.indptr[image], problem.usable.indptr[image + 1])
    kept = [use for use in uses if problem.usable.indices[use] in set(points)]
    return problem.twists[kept].reshape(-1, 6).astype(float)


def predicted(problem, image, points):
    """The corner error by least squares: how errors of the measurements and the prior move the corners."""
    system = np.vstack([rows_of(problem, image, points), np.eye(6) / PRIOR_SIGMA])
    pseudo = np.linalg.pinv(system)
    moved = problem.corner_twists[image].astype(float) @ pseudo
    return np.sqrt((moved.reshape(8, -1) ** 2).sum(axis=1).mean())


def value_of(problem, points):
    """The objective of the selector while no image is satisfied, by the definition."""
    total = 0.0
    for image, uses in enumerate(users(problem)):
        rows = rows_of(problem, image, points)
        determinant = np.linalg.det(np.eye(len(rows)) + PRIOR_SIGMA**2 * rows @ rows.T)
        total += uses[list(points)].sum() + 0.5 * np.log(determinant)
    return total


def some_points(data, problem):
    return data.draw(st.sets(st.integers(0, problem.num_points - 1))) if problem.num_points else set()


@quick
@given(problem=problems(), data=st.data())
def test_the_predicted_error_is_that_of_the_least_squares_solution(problem, data):
    points = np.array(sorted(some_points(data, problem)), np.int64)
    expected = [predicted(problem, image, points) for image in range(problem.num_images)]
    assert problem.corner_errors(points) == pytest.approx(expected, rel=1e-4)
    everything = [predicted(problem, image, range(problem.num_points)) for image in range(problem.num_images)]
    assert problem.best_corner_errors == pytest.approx(everything, rel=1e-4)


@quick
@given(problem=problems(), data=st.data())
def test_more_points_never_raise_a_predicted_error(problem, data):
    fewer = some_points(data, problem)
    more = fewer | some_points(data, problem)
    fewer, more = (np.array(sorted(points), np.int64) for points in (fewer, more))
    assert (problem.corner_errors(more) <= problem.corner_errors(fewer) * (1 + 1e-9)).all()


@quick
@given(problem=problems(max_points=12), data=st.data())
def test_the_value_of_a_further_point_falls_with_the_number_chosen(problem, data):
    fewer = some_points(data, problem)
    more = fewer | some_points(data, problem)
    for point in set(range(problem.num_points)) - more:
        to_fewer = value_of(problem, fewer | {point}) - value_of(problem, fewer)
        to_more = value_of(problem, more | {point}) - value_of(problem, more)
        assert -1e-9 <= to_more <= to_fewer + 1e-9


@quick
@given(problem=problems(), cover=st.integers(1, 12))
def test_an_image_is_satisfied_with_its_number_of_points_and_its_target(problem, cover):
    choice = InformationChoice(problem)
    choice.extend(cover, problem.num_points)
    chosen, usable = np.array(choice.chosen, np.int64), problem.points_per_image
    assert (users(problem)[:, chosen].sum(axis=1) >= np.minimum(cover, usable)).all()
    target = problem.best_corner_errors * np.sqrt(np.maximum(usable / cover, 1))
    assert (problem.corner_errors(chosen) <= target * (1 + 1e-5)).all()


@quick
@given(problem=problems(), cover=st.integers(1, 12))
def test_the_last_point_chosen_was_needed(problem, cover):
    choice = InformationChoice(problem)
    if choice.extend(cover, problem.num_points) == 0:
        return
    without, usable = np.array(choice.chosen[:-1], np.int64), problem.points_per_image
    few = users(problem)[:, without].sum(axis=1) < np.minimum(cover, usable)
    target = problem.best_corner_errors * np.sqrt(np.maximum(usable / cover, 1))
    assert (few | (problem.corner_errors(without) > target)).any()


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 4))
def test_greedy_reaches_its_guaranteed_share_of_the_best_set(seed, count):
    rng = np.random.default_rng(seed)
    uses = np.ones((3, 10), bool)  # dense: no image is satisfied by `count` points
    for row in uses:
        row[rng.permutation(10)[: rng.integers(0, 5)]] = False
    problem = problem_of(uses, seed)
    best = max(value_of(problem, points) for points in combinations(range(10), count))
    ours = value_of(problem, information(problem, count).tolist())
    assert (1 - 1 / np.e) * best <= ours <= best + 1e-9


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_each_choice_has_the_largest_value_while_no_image_is_satisfied(seed):
    problem = problem_of(np.random.default_rng(seed).random((4, 25)) < 0.7, seed)
    chosen = information(problem, 5).tolist()
    for step, point in enumerate(chosen):
        gains = [
            value_of(problem, [*chosen[:step], other]) for other in range(25) if other not in chosen[:step]
        ]
        assert value_of(problem, [*chosen[:step], point]) == pytest.approx(max(gains), abs=1e-6)


@pytest.mark.parametrize("kept", [15, 40, 120])
def test_the_prediction_agrees_with_poses_estimated_from_noisy_pixels(kept):
    """The prior makes it too good for the least determined pose: without it, it is right for any."""
    map_ = exact_map()
    problem = selection_problem(map_, LeftOut(map_))
    points = np.random.default_rng(1).permutation(problem.num_points)[:kept]
    from_points = problem.information(points) - np.eye(6) / PRIOR_SIGMA**2
    without_prior = rms_corner_errors(np.linalg.inv(from_points), problem.corner_twists)
    for row, name in list(enumerate(map_.images))[:2]:
        in_world, true = map_.points3D_in_world[points], map_.images[name].cam_from_world()
        found = root_mean_square_error(in_world, true, map_.camera(name))
        assert without_prior[row] == pytest.approx(found, rel=0.12)
        if kept >= 40:
            assert problem.corner_errors(points)[row] == pytest.approx(found, rel=0.25)


def root_mean_square_error(in_world, true, camera, runs=200):
    """Of the corners, in diagonals, when poses are estimated from pixels with noise of 1 px."""
    rng, options, squares = np.random.default_rng(0), RansacOptions(max_error_px=12.0), []
    pixels = project(in_world, true, camera)
    for _ in range(runs):
        found = estimate_pose(pixels + rng.normal(size=pixels.shape), in_world, camera, options)
        shifts = found.cam_from_world * BOX.corners - true * BOX.corners
        squares.append((shifts**2).sum(axis=1).mean() / BOX.diagonal**2)
    return np.sqrt(np.mean(squares))


def test_twists_are_the_derivatives_of_the_projection():
    map_ = exact_map(num_points=15)
    problem = selection_problem(map_, LeftOut(map_))
    pinhole = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 502.5, 640, 480)
    step = 1e-5
    for row, image in enumerate(map_.images.values()):
        uses = slice(problem.usable.indptr[row], problem.usable.indptr[row + 1])
        points = map_.points3D_in_world[problem.usable.indices[uses]]
        for parameter, direction in enumerate(np.eye(6)):
            ends = [moved(image.cam_from_world(), sign * step * direction) for sign in (1, -1)]
            pixels = [project(points, pose, pinhole) for pose in ends]
            slopes = (pixels[0] - pixels[1]) / (2 * step)
            assert problem.twists[uses, :, parameter] == pytest.approx(slopes, rel=1e-3, abs=0.05)
            corners = (ends[0] * BOX.corners - ends[1] * BOX.corners) / (2 * step * BOX.diagonal)
            assert problem.corner_twists[row, :, parameter] == pytest.approx(corners.ravel(), abs=1e-4)


def moved(cam_from_world, motion):
    """The pose after a small turn, a vector in radians, and a shift, in diagonals, of the camera's frame."""
    quaternion = np.append(motion[:3] / 2, 1.0)
    rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
    return pycolmap.Rigid3d(rotation, motion[3:] * BOX.diagonal) * cam_from_world
