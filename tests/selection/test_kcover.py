from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from random_problems import problem_of, problems, users

from slimsfm.selection import kcover
from slimsfm.selection.problem import most_cover
from slimsfm.selection.selectors import KCover

quick = settings(deadline=None, max_examples=40)


def covers(uses, chosen, cover):
    return (uses[:, list(chosen)].sum(axis=1) >= np.minimum(uses.sum(axis=1), cover)).all()


def smallest_size(uses, cover):
    points = range(uses.shape[1])
    sets = (chosen for size in range(uses.shape[1] + 1) for chosen in combinations(points, size))
    return next(len(chosen) for chosen in sets if covers(uses, chosen, cover))


def greedy(problem, cover):
    made = KCover(problem)
    made.extend(cover, problem.num_points)
    return made.chosen


@quick
@given(problem=problems(max_images=6, max_points=10), cover=st.integers(1, 6))
def test_the_greedy_cover_covers_and_is_within_its_bound_of_the_smallest(problem, cover):
    uses, chosen = users(problem), greedy(problem, cover)
    assert covers(uses, chosen, cover)
    smallest = smallest_size(uses, cover)
    most_used = uses.sum(axis=0).max(initial=1)
    assert smallest <= len(chosen) <= (1 + np.log(max(most_used, 1))) * smallest


@quick
@given(problem=problems(), count=st.integers(1, 40))
def test_the_budget_is_spent_on_a_cover_that_fits_when_the_next_does_not(problem, count):
    chosen, most = kcover(problem, count).tolist(), int(problem.points_per_image.max(initial=0))
    sets = [greedy(problem, cover) for cover in range(most + 1)]
    assert any(
        len(sets[cover]) <= count
        and chosen[: len(sets[cover])] == sets[cover]
        and (cover == most or len(sets[cover + 1]) > count)
        for cover in range(most + 1)
    )


@quick
@given(problem=problems(max_images=6, max_points=9), count=st.integers(1, 9))
def test_no_set_of_points_covers_more_than_the_bound(problem, count):
    uses = users(problem)
    bound = most_cover(problem, count)
    if bound < problem.points_per_image.max(initial=0):
        assert smallest_size(uses, bound + 1) > count
    else:
        assert bound == problem.points_per_image.max(initial=0)


def test_the_point_that_most_images_use_comes_first_and_ties_go_to_the_lower():
    uses = np.array([[1, 0, 1, 0, 1], [0, 1, 1, 0, 1], [0, 1, 0, 1, 1]], bool)
    assert kcover(problem_of(uses), 5).tolist() == [4, 1, 2, 0, 3]


def test_an_image_that_is_covered_counts_no_more():
    uses = np.zeros((5, 6), bool)
    uses[:4, :3] = True
    uses[4, 3:] = True
    assert kcover(problem_of(uses), 4).tolist() == [0, 1, 3, 4]
