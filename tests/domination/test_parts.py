"""The optional parts of a problem: what they mean, and which are refused."""

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
def test_the_checkers_follow_the_definition_for_every_set_without_nodes_forced_out(parts):
    problem = DominationProblem(**parts)
    sets = all_sets(problem)
    sets = sets[~sets[:, list(problem.forced_out)].any(axis=1)]
    unmet, errors = unmet_of(problem, sets)[0], errors_of(problem, sets)
    for indicator, num_unmet, error in zip(sets, unmet, errors, strict=True):
        chosen = np.flatnonzero(indicator).tolist()
        assert problem.num_unmet(chosen) == num_unmet
        assert problem.total_error(chosen) == error
        assert problem.cost(chosen) == problem.costs[chosen].sum()
        kept = set(problem.forced_in) <= set(chosen)
        within = num_unmet == 0 if problem.budget is None else problem.cost(chosen) <= problem.budget
        assert problem.satisfies(chosen) == (kept and within)


def test_a_node_forced_out_may_not_be_chosen():
    assert not DominationProblem(PATH, forced_out=[2]).satisfies([0, 1, 2])


def test_a_node_that_could_have_too_few_dominators_asks_for_all_of_them():
    problem = DominationProblem(PATH | PATH.T, dominators=2)
    assert problem.satisfies([1])
    assert not problem.satisfies([0])
    assert problem.satisfies([0, 2])
    assert DominationProblem(PATH, dominators=2, forced_out=[1]).satisfies([0, 2])


def test_a_node_that_none_can_dominate_is_chosen_itself():
    problem = DominationProblem(PATH, dominators=2)
    assert problem.satisfies([0, 1])
    assert not problem.satisfies([1, 2])


def test_a_node_forced_out_asks_for_as_many_dominators_as_there_are():
    problem = DominationProblem(PATH, dominators=2, forced_out=[2])
    assert problem.satisfies([0, 1])
    assert not problem.satisfies([0])


def test_a_node_forced_out_that_none_can_dominate_asks_for_nothing():
    assert DominationProblem(PATH, forced_out=[0]).satisfies([1])


def test_each_unchosen_node_counts_with_its_least_error_from_a_chosen_one():
    errors = np.array([[9.0, 3.0, 5.0], [9.0, 9.0, 2.0], [9.0, 9.0, 9.0]])
    problem = DominationProblem(np.ones((3, 3)), errors=errors)
    assert problem.total_error([0]) == 8
    assert problem.total_error([0, 1]) == 2
    assert problem.total_error([0, 1, 2]) == 0


def test_errors_are_taken_from_the_edges_alone_and_may_be_stored_zeros():
    rows, columns, values = [0, 1, 2], [1, 2, 0], [0.0, 4.0, 7.0]
    problem = DominationProblem(PATH, errors=csr_array((values, (rows, columns)), shape=(3, 3)))
    assert problem.total_error([0, 1]) == 4
    assert problem.total_error([0, 2]) == 0


def test_costs_that_are_whole_give_whole_sums():
    assert repr(DominationProblem(PATH).cost([0, 1])) == "2"
    assert repr(DominationProblem(PATH, costs=np.array([1, 0.5, 1])).cost([0, 1])) == "1.5"


def test_nodes_are_kept_in_order_and_once():
    problem = DominationProblem(PATH, forced_in=[2, 0, 2], forced_out=(1,))
    assert problem.forced_in == (0, 2)
    assert problem.forced_out == (1,)


@pytest.mark.parametrize(
    ("given_parts", "message"),
    [
        ({"costs": np.ones(2)}, r"costs must be one a node, of shape \(3,\), got shape \(2,\)"),
        ({"costs": np.array([1, 0, 1])}, "costs must be positive and finite, got 0.0"),
        ({"costs": np.array([1, np.nan, 1])}, "costs must be positive and finite, got nan"),
        ({"dominators": 0}, "dominators must be at least 1, got 0"),
        ({"budget": -1}, "budget must be at least 0, the cost of forced_in, got -1"),
        ({"budget": float("nan")}, "budget must be at least 0, the cost of forced_in, got nan"),
        ({"budget": 1, "forced_in": [0, 1]}, "budget must be at least 2, the cost of forced_in, got 1"),
        ({"forced_in": [3]}, r"forced_in must be nodes in \[0, 3\), got \[3\]"),
        ({"forced_out": [-1]}, r"forced_out must be nodes in \[0, 3\), got \[-1\]"),
        ({"forced_in": [0, 1], "forced_out": [1]}, r"must have no node in common, got \[1\] in both"),
        ({"groups": np.ones((1, 2))}, r"groups must be a matrix of 3 columns, got shape \(1, 2\)"),
        ({"groups": np.full((1, 3), np.nan)}, "groups must be finite"),
        ({"groups": np.array([["a", "b", "c"]])}, "groups must be boolean or real"),
        ({"groups": np.array([[1, 0, 0], [0, 0, 0]])}, r"groups must each have a node .* got none in \[1\]"),
        ({"groups": np.eye(3)[:1], "forced_out": [0]}, r"groups must each have a node .* got none in \[0\]"),
        ({"errors": np.ones((2, 2))}, r"errors must be of shape \(3, 3\), got \(2, 2\)"),
        ({"errors": np.full((3, 3), -1.0)}, r"errors must be .* got -1.0 on \(0, 1\)"),
        ({"errors": np.full((3, 3), np.inf)}, r"errors must be .* got inf on \(0, 1\)"),
        ({"errors": csr_array((3, 3))}, r"errors must be .* got none on \(0, 1\)"),
    ],
)
def test_a_part_that_cannot_be_is_refused(given_parts, message):
    with pytest.raises(ValueError, match=message):
        DominationProblem(PATH, **given_parts)
