"""Every solver on every combination of the optional parts, against all sets of small graphs."""

import subprocess
import sys

import numpy as np
import pytest
from digraphs import best_merit, every_solver, needs_ortools, problem_parts, proving_solvers, view_graph
from hypothesis import given, settings

from slimsfm.domination import DominationProblem, cpsat, exact, greedy
from slimsfm.domination.problem import merit
from slimsfm.errors import SlimsfmError

quick = settings(deadline=None, max_examples=25)
RANDOM = np.random.default_rng(0).random((80, 80))


@every_solver
@quick
@given(parts=problem_parts())
def test_every_solver_satisfies_every_problem_and_its_bounds_hold(solve, parts):
    problem = DominationProblem(**parts)
    solution = solve(problem)
    unmet, cost, error = best_merit(problem)
    assert problem.satisfies(solution.chosen)
    assert solution.unmet_bound <= unmet <= solution.unmet == problem.num_unmet(solution.chosen)
    assert solution.lower_bound <= cost
    assert solution.error_bound <= error + 1e-6
    assert solution.cost == problem.cost(solution.chosen)
    assert solution.error == problem.total_error(solution.chosen)
    assert (unmet, cost, error) <= merit(problem, solution.chosen)
    if solution.is_optimal:
        assert (unmet, cost, error) == merit(problem, solution.chosen)


@proving_solvers
@settings(quick, max_examples=60)
@given(parts=problem_parts())
def test_integer_programming_finds_and_proves_the_optimum_of_an_exhaustive_search(solve, parts):
    problem = DominationProblem(**parts)
    solution = solve(problem)
    assert merit(problem, solution.chosen) == best_merit(problem)
    assert solution.is_optimal


@every_solver
@settings(quick, max_examples=15)
@given(parts=problem_parts(max_nodes=12))
def test_equal_seeds_give_equal_solutions_of_every_problem(solve, parts):
    problem = DominationProblem(**parts)
    assert solve(problem, seed=7) == solve(problem, seed=7)


@proving_solvers
@pytest.mark.parametrize("dominators", [1, 2])
def test_costs_of_any_magnitude_are_minimized_within_one_in_a_million(solve, dominators):
    rng = np.random.default_rng(3)
    costs = 10 ** rng.uniform(-2, 2, 12)
    problem = DominationProblem(rng.random((12, 12)) < 0.25, costs=costs, dominators=dominators)
    solution = solve(problem)
    assert solution.is_optimal
    assert solution.cost == pytest.approx(best_merit(problem)[1], rel=1e-6)


@proving_solvers
@pytest.mark.parametrize("time_limit_s", [1e-9, 0.1])
@pytest.mark.parametrize(
    "parts", [{}, {"budget": 9}, {"dominators": 2, "errors": RANDOM}], ids=["plain", "budget", "errors"]
)
def test_out_of_time_the_set_is_no_worse_than_greedys(solve, time_limit_s, parts):
    problem = DominationProblem(RANDOM < 0.08, **parts)
    solution = solve(problem, time_limit_s=time_limit_s)
    assert problem.satisfies(solution.chosen)
    assert merit(problem, solution.chosen) <= merit(problem, greedy(problem).chosen)
    if time_limit_s < 0.1:
        assert not solution.is_optimal


def test_among_fewest_images_those_with_least_error_are_chosen():
    adjacency = view_graph(60)
    errors = np.random.default_rng(1).random(adjacency.shape)
    fewest, best = (exact(DominationProblem(adjacency, **parts)) for parts in ({}, {"errors": errors}))
    problem = DominationProblem(adjacency, errors=errors)
    assert best.is_optimal
    assert best.cost == fewest.cost
    assert best.error <= problem.total_error(fewest.chosen)
    assert best.error <= greedy(problem).error


def test_more_dominators_never_cost_less_and_more_budget_never_meets_less():
    adjacency = view_graph(30)
    costs = [exact(DominationProblem(adjacency, dominators=k)).cost for k in (1, 2, 3)]
    unmet = [exact(DominationProblem(adjacency, budget=p)).unmet for p in range(int(costs[0]) + 1)]
    assert costs == sorted(costs)
    assert unmet == sorted(unmet, reverse=True)
    assert unmet[0] == 30
    assert unmet[-1] == 0
    assert unmet[-2] > 0


def test_a_sufficient_budget_does_not_change_the_cost():
    adjacency = view_graph(50)
    assert exact(DominationProblem(adjacency, budget=50)).cost == exact(DominationProblem(adjacency)).cost


@needs_ortools
@pytest.mark.parametrize("time_limit_s", [0.0, -1.0, float("nan")])
def test_the_time_limit_of_cpsat_must_be_positive(time_limit_s):
    with pytest.raises(ValueError, match="time_limit_s must be positive"):
        cpsat(DominationProblem(np.ones((2, 2))), time_limit_s=time_limit_s)


def test_without_or_tools_cpsat_says_how_to_get_them(monkeypatch):
    monkeypatch.setitem(sys.modules, "ortools.sat.python.cp_model", None)
    with pytest.raises(SlimsfmError, match=r"pip install 'slimsfm\[cpsat\]'"):
        cpsat(DominationProblem(np.ones((2, 2))))


def test_importing_the_solvers_does_not_import_or_tools():
    code = "import sys; import slimsfm.domination; sys.exit('ortools' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
