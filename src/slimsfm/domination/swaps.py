"""Swaps of one chosen node for another that reduce the total error at no greater cost."""

import numpy as np

from slimsfm.domination.problem import DominationProblem
from slimsfm.domination.solution import merit

_MOST_ROUNDS = 10
_ENTRIES = 150_000_000  # of the adjacency, to be looked at by all rounds together


def least_error_by_swaps(problem: DominationProblem, chosen: tuple[int, ...]) -> tuple[int, ...]:
    """Swap chosen nodes for others while that leaves the total error smaller, and nothing else worse.

    A round looks for the best replacement of each chosen node, ascending. Rounds end when no swap helps, or
    after ten; after fewer on large graphs, but never before the first.

    Args:
        problem: A problem with errors.
        chosen: A set that keeps to it, ascending.

    Returns:
        A set that is no worse: in number unmet, then cost, then error.
    """
    entries_a_round = max(1, len(chosen) * problem.adjacency.nnz)
    for _ in range(max(1, min(_MOST_ROUNDS, _ENTRIES // entries_a_round))):
        before = chosen
        for node in before:
            if node not in problem.forced_in:
                chosen = _swapped(problem, chosen, node)
        if chosen == before:
            break
    return chosen


def _swapped(problem: DominationProblem, chosen: tuple[int, ...], node: int) -> tuple[int, ...]:
    """The set with the node swapped for its best replacement if that is better, else the set itself."""
    rest = np.array([other for other in chosen if other != node], dtype=np.int64)
    others, num_met = _replacements(problem, rest, node)
    if len(others) == 0:
        return chosen
    order = np.lexsort((others, _changes(problem, rest, others), problem.costs[others], -num_met))
    swapped = tuple(sorted([*rest.tolist(), int(others[order[0]])]))
    return swapped if merit(problem, swapped) < merit(problem, chosen) else chosen


def _replacements(problem: DominationProblem, rest: np.ndarray, node: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes at no greater cost that meet no less of what is unmet, and how much each of them meets."""
    matrix, needs = problem.requirements
    indicator = np.zeros(problem.num_nodes, dtype=np.int64)
    indicator[rest] = 1
    residual = needs - matrix @ indicator
    unmet = np.flatnonzero(residual > 0)
    part = matrix[unmet]
    lacking = np.repeat(residual[unmet], np.diff(part.indptr))
    num_met = np.bincount(part.indices[part.data >= lacking], minlength=problem.num_nodes)
    allowed = problem.costs <= problem.costs[node]
    allowed[rest] = allowed[node] = False
    allowed[list(problem.forced_out)] = False
    others = np.flatnonzero(allowed & (num_met >= num_met[node]))
    return others, num_met[others]


def _changes(problem: DominationProblem, rest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """By how much the total error changes when each of some nodes joins the rest."""
    errors = problem.errors
    if errors is None:
        return np.zeros(len(others))
    best = np.full(problem.num_nodes, np.inf)
    reached = errors[rest]
    np.minimum.at(best, reached.indices, reached.data)
    now = np.where(np.isfinite(best), best, 0.0)
    rows = errors[others]
    of_entry = np.repeat(np.arange(len(others)), np.diff(rows.indptr))
    change = np.minimum(best[rows.indices], rows.data) - now[rows.indices]
    return np.bincount(of_entry, weights=change, minlength=len(others))
