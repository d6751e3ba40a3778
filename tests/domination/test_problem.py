import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.sparse import csr_array

from slimsfm.domination import DominationProblem, Solution, dominates

quick = settings(deadline=None, max_examples=60)
matrices = st.integers(0, 8).flatmap(lambda n: arrays(bool, (n, n)))
nonempty_matrices = st.integers(1, 8).flatmap(lambda n: arrays(bool, (n, n)))


@quick
@given(adjacency=nonempty_matrices, data=st.data())
def test_the_checker_agrees_with_networkx_on_undirected_graphs(adjacency, data):
    symmetric = adjacency | adjacency.T
    chosen = data.draw(st.sets(st.integers(0, len(adjacency) - 1)))
    graph = nx.from_numpy_array(symmetric.astype(int))
    assert dominates(symmetric, chosen) == nx.is_dominating_set(graph, chosen)


@quick
@given(adjacency=nonempty_matrices, data=st.data())
def test_the_checker_follows_the_direction_of_the_edges(adjacency, data):
    chosen = data.draw(st.sets(st.integers(0, len(adjacency) - 1)))
    expected = all(v in chosen or any(adjacency[u, v] for u in chosen) for v in range(len(adjacency)))
    assert dominates(adjacency, chosen) == expected


@quick
@given(adjacency=matrices)
def test_equal_graphs_have_one_form_dense_or_sparse_with_or_without_a_diagonal(adjacency):
    n = len(adjacency)
    closed = adjacency | np.eye(n, dtype=bool)
    rows, columns = np.indices((n, n)).reshape(2, -1)
    with_stored_zeros = csr_array((adjacency.ravel() * 0.5, (rows, columns)), shape=(n, n))
    for given_form in (adjacency, closed, adjacency.astype(int), csr_array(adjacency), with_stored_zeros):
        form = DominationProblem(given_form).adjacency
        assert np.array_equal(form.toarray(), closed)
        assert np.array_equal(form.indices, np.nonzero(closed)[1])
        assert form.dtype == bool


def test_the_problem_leaves_what_it_was_given_untouched_and_does_not_follow_its_changes():
    matrix = csr_array(np.array([[0.0, 2.0], [0.0, 0.0]]))
    problem = DominationProblem(matrix)
    assert matrix.nnz == 1
    matrix.data[:] = 0.0
    assert problem.adjacency.toarray().tolist() == [[True, True], [False, True]]


@pytest.mark.parametrize("shape", [(3,), (2, 3), (2, 2, 2)])
def test_a_matrix_that_is_not_square_is_refused(shape):
    with pytest.raises(ValueError, match="adjacency must be a square matrix"):
        DominationProblem(np.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("form", [np.asarray, csr_array], ids=["dense", "sparse"])
def test_a_matrix_that_is_not_finite_is_refused(form, value):
    with pytest.raises(ValueError, match="adjacency must be finite"):
        DominationProblem(form(np.array([[0.0, value], [0.0, 0.0]])))


def test_a_matrix_of_words_is_refused():
    with pytest.raises(ValueError, match="adjacency must be boolean or real"):
        DominationProblem(np.array([["yes"]]))


@pytest.mark.parametrize("node", [-1, 2])
def test_a_chosen_node_must_be_in_the_graph(node):
    with pytest.raises(ValueError, match=r"chosen must be nodes in \[0, 2\)"):
        dominates(np.ones((2, 2)), [node])


def test_a_solution_is_optimal_when_its_cost_meets_the_bound():
    assert Solution(chosen=(1, 4), cost=2, lower_bound=2).is_optimal
    assert Solution(chosen=(1, 4, 5), cost=3, lower_bound=1).gap == 2
    assert not Solution(chosen=(1, 4, 5), cost=3, lower_bound=1).is_optimal


@pytest.mark.parametrize("value", ["unmet", "error"])
def test_a_solution_is_optimal_only_if_all_that_was_asked_for_is(value):
    more = {value: 2.0, f"{value}_bound": 1.0} if value == "error" else {value: 2, f"{value}_bound": 1}
    assert not Solution(chosen=(1, 4), cost=2, lower_bound=2, **more).is_optimal
    assert Solution(
        chosen=(1, 4), cost=2, lower_bound=2, **{**more, value: more[f"{value}_bound"]}
    ).is_optimal


def test_how_long_a_search_took_takes_no_part_in_comparing_solutions():
    fast, slow = (Solution(chosen=(1,), cost=1, lower_bound=1, seconds=s) for s in (0.1, 9.0))
    assert fast == slow


@pytest.mark.parametrize("chosen", [(2, 1), (1, 1)])
def test_a_solution_out_of_order_is_refused(chosen):
    with pytest.raises(ValueError, match="chosen must be ascending"):
        Solution(chosen=chosen, cost=2, lower_bound=0)


@pytest.mark.parametrize("lower_bound", [-1, 3])
def test_an_impossible_lower_bound_is_refused(lower_bound):
    with pytest.raises(ValueError, match="lower_bound must be in"):
        Solution(chosen=(0, 1), cost=2, lower_bound=lower_bound)
