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
    order = rng.permutation(n).tolist()
    num_in, num_out = draw(st.integers(0, n // 4)), draw(st.integers(0, n // 3))
    forced_in, forced_out = order[:num_in], order[num_in : num_in + num_out]
    budget = None
    if draw(st.booleans()):
        spent = len(forced_in) if costs is None else float(costs[forced_in].sum())
        budget = spent + draw(st.integers(0, 2 * n)) / 4
    return {
        "adjacency": adjacency,
        "costs": costs,
        "dominators": draw(st.integers(1, 3)),
        "budget": budget,
        "forced_in": forced_in,
        "forced_out": forced_out,
        "groups": _groups(rng, n, forced_out, order[-1]) if draw(st.booleans()) else None,
        "errors": rng.integers(0, 20, (n, n)) / 8 if draw(st.booleans()) else None,
    }


def _groups(rng, n, forced_out, allowed):
    groups = rng.random((rng.integers(1, 4), n)) < 0.3
    lost = ~groups[:, np.setdiff1d(np.arange(n), forced_out)].any(axis=1)
    groups[lost, allowed] = True
    return groups


def all_sets(problem):
    """Row s: the indicator of the set whose members are the binary digits of s."""
    return (np.arange(2**problem.num_nodes)[:, None] >> np.arange(problem.num_nodes)) & 1 == 1


def unmet_of(problem, sets):
    """How much each set leaves unmet, straight from the definition."""
    n, k = problem.num_nodes, problem.dominators
    edges = problem.adjacency.toarray() & ~np.eye(n, dtype=bool)
    out = np.isin(np.arange(n), problem.forced_out)
    dominators = sets.astype(int) @ edges
    available = edges[~out].sum(axis=0)
    asked = np.where(available > 0, np.minimum(k, available), np.where(out, 0, n))
    met = sets | (dominators >= asked)
    in_group = sets.astype(int) @ problem.groups.toarray().T.astype(int) > 0
    return (~met).sum(axis=1) + (~in_group).sum(axis=1), met


def errors_of(problem, sets):
    """The total error of each set, straight from the definition."""
    if problem.errors is None:
        return np.zeros(len(sets))
    _, met = unmet_of(problem, sets)
    edges = problem.adjacency.toarray()
    errors = np.where(edges, problem.errors.toarray(), np.inf)
    least = np.where(sets[:, :, None], errors, np.inf).min(axis=1, initial=np.inf)
    return np.where(met & ~sets & np.isfinite(least), least, 0).sum(axis=1)


def best_merit(problem):
    """The least of number unmet, cost and error, in this order, of all sets that keep to a problem."""
    sets = all_sets(problem)
    unmet, costs, errors = unmet_of(problem, sets)[0], sets @ problem.costs, errors_of(problem, sets)
    fits = unmet == 0 if problem.budget is None else costs <= problem.budget
    fits &= sets[:, list(problem.forced_in)].all(axis=1) & ~sets[:, list(problem.forced_out)].any(axis=1)
    best = np.lexsort((errors[fits], costs[fits], unmet[fits]))[0]
    return int(unmet[fits][best]), float(costs[fits][best]), float(errors[fits][best])


def view_graph(num_views, *, seed=0):
    """Views spread over a sphere; each dominates those within an angle of its own, of 20 to 40 degrees."""
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
