from math import exp, log

import numpy as np
import pytest
from digraphs import all_sets, best_merit, digraphs, problem_parts, unmet_of
from hypothesis import given, settings
from hypothesis import strategies as st

from slimsfm.domination import DominationProblem, cover_order

quick = settings(deadline=None, max_examples=60)


@quick
@given(parts=problem_parts(), data=st.data())
def test_the_order_has_every_node_once_and_the_first_ones_first(parts, data):
    problem = DominationProblem(**parts)
    first = data.draw(st.sets(st.integers(0, problem.num_nodes - 1)))
    order = cover_order(problem, first=first)
    assert sorted(order) == list(range(problem.num_nodes))
    assert set(order[: len(first)]) == first
    assert cover_order(problem, first=first) == order


@quick
@given(adjacency=digraphs(min_nodes=1, max_nodes=11))
def test_every_prefix_covers_nearly_as_much_as_the_best_set_of_its_size(adjacency):
    problem = DominationProblem(adjacency)
    sets = all_sets(problem)
    covered = len(adjacency) - unmet_of(problem, sets)[0]
    order = cover_order(problem)
    for size in range(len(order) + 1):
        best = covered[sets.sum(axis=1) == size].max()
        assert len(adjacency) - problem.num_unmet(order[:size]) >= (1 - exp(-1)) * best


@quick
@given(adjacency=digraphs(min_nodes=1, max_nodes=11))
def test_the_prefix_that_covers_all_is_not_much_larger_than_the_smallest_set(adjacency):
    problem = DominationProblem(adjacency)
    order = cover_order(problem)
    size = next(p for p in range(len(order) + 1) if problem.num_unmet(order[:p]) == 0)
    most = np.diff(problem.adjacency.indptr).max()
    assert size <= (1 + log(most)) * best_merit(problem)[1]


@quick
@given(adjacency=digraphs(min_nodes=1, max_nodes=15))
def test_the_order_is_that_of_evaluating_all_gains_at_every_step(adjacency):
    closed = adjacency | np.eye(len(adjacency), dtype=bool)
    counts, level, expected = np.zeros(len(closed), dtype=int), 1, []
    while len(expected) < len(closed):
        lacking = counts < np.minimum(level, closed.sum(axis=0))
        gains = {u: int((closed[u] & lacking).sum()) for u in range(len(closed)) if u not in expected}
        best = max(gains, key=lambda u: (gains[u], -u))
        if gains[best] == 0:
            level += 1
            continue
        expected.append(best)
        counts += closed[best]
    assert cover_order(DominationProblem(adjacency)) == tuple(expected)


def test_a_node_costs_what_it_covers():
    star = np.zeros((4, 4), dtype=bool)
    star[0] = True
    assert cover_order(DominationProblem(star))[0] == 0
    assert cover_order(DominationProblem(star, costs=np.array([5.0, 1, 1, 1])))[0] == 1


def test_the_empty_graph_has_the_empty_order():
    assert cover_order(DominationProblem(np.zeros((0, 0)))) == ()


def test_first_must_be_in_the_graph():
    with pytest.raises(ValueError, match=r"first must be nodes in \[0, 2\), got \[2\]"):
        cover_order(DominationProblem(np.ones((2, 2))), first=[2])
