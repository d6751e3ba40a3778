"""The optional parts of a problem: their meaning, and which values are refused."""

import numpy as np
import pytest
from digraphs import all_sets, errors_of, problem_parts, unmet_of
from hypothesis import given, settings
from scipy.sparse import csr_array

from slimsfm.domination import DominationProblem

quick = settings(deadline=None, max_examples=40)
PATH = np.eye(3, k=1, dtype=bool)  # 0 -> 1 -> 2


@quick
@given(parts=problem_parts(max_nodes=7))
def test_the_checkers_follow_the_definition_for_every_set(parts):
    problem = DominationProblem(**parts)
    sets = all_sets(problem)
    unmet, errors = unmet_of(problem, sets)[0], errors_of(problem, sets)
    for indicator, num_unmet, error in zip(sets, unmet, errors, strict=True):
        chosen = np.flatnonzero(indicator).tolist()
        assert problem.num_unmet(chosen) == num_unmet
        assert problem.total_error(chosen) == error
        assert problem.cost(chosen) == problem.costs[chosen].sum()
        within = num_unmet == 0 if problem.budget is None else problem.cost(chosen) <= problem.budget
        assert problem.satisfies(chosen) == within


def test_a_node_with_fewer_than_k_possible_dominators_needs_all_of_them():
    problem = DominationProblem(PATH | PATH.T, dominators=2)
    assert problem.satisfies([1])
    assert not problem.satisfies([0])
    assert problem.satisfies([0, 2])


def test_a_node_that_no_other_dominates_is_chosen_itself():
    problem = DominationProblem(PATH, dominators=2)
    assert problem.satisfies([0, 1])
    assert not problem.satisfies([1, 2])


def test_each_unchosen_node_counts_with_its_least_error_from_a_chosen_one():
    errors = np.array([[9.0, 3.0, 5.0], [9.0, 9.0, 2.0], [9.0, 9.0, 9.0]])
    problem = DominationProblem(np.ones((3, 3)), errors=errors)
    assert problem.total_error([0]) == 8
    assert problem.total_error([0, 1]) == 2
    assert problem.total_error([0, 1, 2]) == 0


def test_errors_are_read_on_edges_only_and_stored_zeros_count():
    rows, columns, values = [0, 1, 2], [1, 2, 0], [0.0, 4.0, 7.0]
    problem = DominationProblem(PATH, errors=csr_array((values, (rows, columns)), shape=(3, 3)))
    assert problem.total_error([0, 1]) == 4
    assert problem.total_error([0, 2]) == 0


def test_integer_costs_give_integer_sums():
    assert repr(DominationProblem(PATH).cost([0, 1])) == "2"
    assert repr(DominationProblem(PATH, costs=np.array([1, 0.5, 1])).cost([0, 1])) == "1.5"


@pytest.mark.parametrize(
    ("given_parts", "message"),
    [
        ({"costs": np.ones(2)}, r"costs must be one per node, of shape \(3,\), got shape \(2,\)"),
        ({"costs": np.array([1, 0, 1])}, "costs must be positive and finite, got 0.0"),
        ({"costs": np.array([1, np.nan, 1])}, "costs must be positive and finite, got nan"),
        ({"dominators": 0}, "dominators must be at least 1, got 0"),
        ({"budget": -1}, "budget must not be negative, got -1"),
        ({"budget": float("nan")}, "budget must not be negative, got nan"),
        ({"groups": np.ones((1, 2))}, r"groups must be a matrix of 3 columns, got shape \(1, 2\)"),
        ({"groups": np.full((1, 3), np.nan)}, "groups must be finite"),
        ({"groups": np.array([["a", "b", "c"]])}, "groups must be boolean or real"),
        ({"groups": np.array([[1, 0, 0], [0, 0, 0]])}, r"groups must each have a node, got none in \[1\]"),
        ({"errors": np.ones((2, 2))}, r"errors must be of shape \(3, 3\), got \(2, 2\)"),
        ({"errors": np.full((3, 3), -1.0)}, r"errors must be .* got -1.0 on \(0, 1\)"),
        ({"errors": np.full((3, 3), np.inf)}, r"errors must be .* got inf on \(0, 1\)"),
        ({"errors": csr_array((3, 3))}, r"errors must be .* got none on \(0, 1\)"),
    ],
)
def test_an_invalid_part_is_refused(given_parts, message):
    with pytest.raises(ValueError, match=message):
        DominationProblem(PATH, **given_parts)
