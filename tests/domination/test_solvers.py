from itertools import combinations

import networkx as nx
import numpy as np
import pytest
from digraphs import digraphs, every_solver, proving_solvers, view_graph
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import block_diag, csr_array

from slimsfm.domination import DominationProblem, dominates, exact, greedy, random_greedy

quick = settings(deadline=None, max_examples=20)


def smallest_size(adjacency):
    nodes = range(len(adjacency))
    sets = (chosen for size in range(len(adjacency) + 1) for chosen in combinations(nodes, size))
    return next(len(chosen) for chosen in sets if dominates(adjacency, chosen))


@every_solver
@quick
@given(adjacency=digraphs())
def test_every_solver_dominates_every_graph(solve, adjacency):
    solution = solve(DominationProblem(adjacency))
    assert dominates(adjacency, solution.chosen)
    assert solution.lower_bound <= len(solution.chosen)


@every_solver
@quick
@given(adjacency=digraphs(max_nodes=7))
def test_no_lower_bound_exceeds_the_smallest_size(solve, adjacency):
    assert solve(DominationProblem(adjacency)).lower_bound <= smallest_size(adjacency)


@every_solver
@quick
@given(adjacency=digraphs(), seed=st.integers(0, 1000))
def test_equal_seeds_give_equal_solutions(solve, adjacency, seed):
    once, again = (solve(DominationProblem(adjacency.copy()), seed=seed) for _ in range(2))
    assert once == again


@every_solver
def test_the_empty_graph_needs_no_node(solve):
    solution = solve(DominationProblem(np.zeros((0, 0))))
    assert solution.chosen == ()
    assert solution.is_optimal


@every_solver
@pytest.mark.parametrize("n", [1, 2, 17])
def test_isolated_nodes_are_all_chosen(solve, n):
    solution = solve(DominationProblem(np.zeros((n, n))))
    assert solution.chosen == tuple(range(n))
    assert solution.is_optimal


@every_solver
@pytest.mark.parametrize("n", [1, 2, 17])
def test_one_node_dominates_a_complete_graph(solve, n):
    solution = solve(DominationProblem(np.ones((n, n))))
    assert len(solution.chosen) == 1
    assert solution.is_optimal


@proving_solvers
@quick
@given(adjacency=digraphs(max_nodes=9))
def test_integer_programming_finds_and_proves_the_size_of_an_exhaustive_search(solve, adjacency):
    solution = solve(DominationProblem(adjacency))
    assert len(solution.chosen) == solution.lower_bound == smallest_size(adjacency)


@quick
@given(adjacency=digraphs(max_nodes=20))
def test_exact_is_never_larger_than_greedy_nor_greedy_than_random(adjacency):
    problem = DominationProblem(adjacency)
    sizes = [len(solve(problem).chosen) for solve in (exact, greedy, random_greedy)]
    assert sizes == sorted(sizes)


@pytest.mark.parametrize("solve", [exact, greedy, random_greedy])
@quick
@given(adjacency=digraphs(), seed=st.integers(0, 1000))
def test_no_solver_is_beaten_by_networkx(solve, adjacency, seed):
    graph = nx.from_numpy_array((adjacency | adjacency.T).astype(int))
    if len(graph) == 0:
        return
    start = seed % len(graph)
    ours = solve(DominationProblem(adjacency | adjacency.T)).chosen
    assert nx.is_dominating_set(graph, ours)
    assert len(ours) <= len(nx.dominating_set(graph, start_with=start))


def test_exact_proves_a_view_graph_of_a_hundred_images_optimal():
    problem = DominationProblem(view_graph(100))
    solution = exact(problem)
    assert solution.is_optimal
    assert dominates(problem.adjacency, solution.chosen)
    assert len(solution.chosen) < len(random_greedy(problem).chosen)


def test_no_draw_finds_the_two_adjacent_centers_of_a_double_star():
    edges = np.zeros((8, 8), dtype=bool)
    edges[0, [1, 2, 3, 4]] = edges[1, [0, 5, 6, 7]] = True
    problem = DominationProblem(edges | edges.T)
    assert exact(problem).chosen == greedy(problem).chosen == (0, 1)
    assert len(random_greedy(problem).chosen) == 4


def test_more_draws_never_give_a_larger_set():
    problem = DominationProblem(view_graph(80))
    sizes = [len(random_greedy(problem, draws=draws).chosen) for draws in (1, 10, 100, 1000)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < sizes[0]


def test_the_nodes_of_a_single_draw_depend_on_the_seed_as_a_uniform_choice_does():
    """On a directed edge 0→1 one draw is {0} or {0, 1}, each with probability one half."""
    problem = DominationProblem(np.array([[False, True], [False, False]]))
    sizes = [len(random_greedy(problem, draws=1, seed=seed).chosen) for seed in range(1000)]
    assert 440 <= sizes.count(1) <= 560


@pytest.mark.parametrize("draws", [0, -3])
def test_draws_must_be_positive(draws):
    with pytest.raises(ValueError, match=f"draws must be positive, got {draws}"):
        random_greedy(DominationProblem(np.ones((2, 2))), draws=draws)


@pytest.mark.parametrize("time_limit_s", [0.0, -1.0, float("nan")])
def test_the_time_limit_must_be_positive(time_limit_s):
    with pytest.raises(ValueError, match="time_limit_s must be positive"):
        exact(DominationProblem(np.ones((2, 2))), time_limit_s=time_limit_s)


@pytest.mark.parametrize("seed", range(10))
def test_greedy_is_no_larger_than_random_on_view_graphs_and_its_bound_holds(seed):
    problem = DominationProblem(view_graph(60, seed=seed))
    best, ours = exact(problem), greedy(problem)
    assert ours.lower_bound <= len(best.chosen) <= len(ours.chosen) <= len(random_greedy(problem).chosen)


def test_the_paper_solver_still_draws_the_same_set():
    assert random_greedy(DominationProblem(view_graph(40)), seed=3).chosen == (
        4,
        7,
        8,
        9,
        15,
        16,
        19,
        20,
        26,
        29,
        32,
        33,
    )


def test_components_are_solved_apart():
    """Solved as one graph, twenty copies would take far longer than twenty single proofs."""
    one = view_graph(60)
    copies = csr_array(block_diag([one] * 20))
    assert len(exact(DominationProblem(copies)).chosen) == 20 * len(exact(DominationProblem(one)).chosen)
