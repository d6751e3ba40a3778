"""Random problems, and the best solutions of small ones by trying all sets."""

from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import strategies as st

from slimsfm.domination import SOLVERS, cpsat, exact, random_greedy


@st.composite
def digraphs(draw, min_nodes=0, max_nodes=30):
    n = draw(st.integers(min_nodes, max_nodes))
    density = draw(st.floats(0, 1))
    return np.random.default_rng(draw(st.integers(0, 2**32 - 1))).random((n, n)) < density


@st.composite
def problem_parts(draw, max_nodes=12):
    """Arguments of problems with any combination of parts; costs and errors are exact in sums."""
    adjacency = draw(digraphs(min_nodes=1, max_nodes=max_nodes))
    n = len(adjacency)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    costs = rng.integers(1, 9, n) / 4 if draw(st.booleans()) else None
    budget = draw(st.integers(0, 2 * n)) / 4 if draw(st.booleans()) else None
    return {
        "adjacency": adjacency,
        "costs": costs,
        "dominators": draw(st.integers(1, 3)),
        "budget": budget,
        "groups": _groups(rng, n) if draw(st.booleans()) else None,
        "errors": rng.integers(0, 20, (n, n)) / 8 if draw(st.booleans()) else None,
    }


def _groups(rng, n):
    groups = rng.random((rng.integers(1, 4), n)) < 0.3
    groups[~groups.any(axis=1), rng.integers(n)] = True
    return groups


def all_sets(problem):
    """Row s: the indicator of the set whose members are the binary digits of s."""
    return (np.arange(2**problem.num_nodes)[:, None] >> np.arange(problem.num_nodes)) & 1 == 1


def unmet_of(problem, sets):
    """How many requirements each set leaves unmet, by the definition, and which nodes it meets."""
    n, k = problem.num_nodes, problem.dominators
    edges = problem.adjacency.toarray() & ~np.eye(n, dtype=bool)
    dominators = sets.astype(int) @ edges
    available = edges.sum(axis=0)
    asked = np.where(available > 0, np.minimum(k, available), n)
    met = sets | (dominators >= asked)
    in_group = sets.astype(int) @ problem.groups.toarray().T.astype(int) > 0
    return (~met).sum(axis=1) + (~in_group).sum(axis=1), met


def errors_of(problem, sets):
    """The total error of each set, by the definition."""
    if problem.errors is None:
        return np.zeros(len(sets))
    _, met = unmet_of(problem, sets)
    edges = problem.adjacency.toarray()
    errors = np.where(edges, problem.errors.toarray(), np.inf)
    least = np.where(sets[:, :, None], errors, np.inf).min(axis=1, initial=np.inf)
    return np.where(met & ~sets & np.isfinite(least), least, 0).sum(axis=1)


def best_merit(problem):
    """The least of number unmet, cost and error, in this order, of all sets that satisfy a problem."""
    sets = all_sets(problem)
    unmet, costs, errors = unmet_of(problem, sets)[0], sets @ problem.costs, errors_of(problem, sets)
    fits = unmet == 0 if problem.budget is None else costs <= problem.budget
    best = np.lexsort((errors[fits], costs[fits], unmet[fits]))[0]
    return int(unmet[fits][best]), float(costs[fits][best]), float(errors[fits][best])


def view_graph(num_views, *, seed=0):
    """Views on a sphere; each dominates the views within its own angle, between 20 and 40 degrees."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num_views, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    reach_deg = rng.uniform(20, 40, num_views)
    return directions @ directions.T >= np.cos(np.radians(reach_deg))[:, None]


needs_ortools = pytest.mark.skipif(
    find_spec("ortools") is None, reason="needs OR-Tools, which is not installed"
)
quick_solvers = {**SOLVERS, "random": partial(random_greedy, draws=50)}
every_solver = pytest.mark.parametrize(
    "solve",
    [
        pytest.param(solve, id=name, marks=needs_ortools if name == "cpsat" else ())
        for name, solve in quick_solvers.items()
    ],
)
proving_solvers = pytest.mark.parametrize(
    "solve", [pytest.param(exact, id="exact"), pytest.param(cpsat, id="cpsat", marks=needs_ortools)]
)
