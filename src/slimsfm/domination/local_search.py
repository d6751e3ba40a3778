"""Local search: weighted swaps on covers, and swaps of nodes that reduce the total error."""

from dataclasses import dataclass, field

import numpy as np

from slimsfm.domination.cover import Columns, Cover, Rows
from slimsfm.domination.problem import DominationProblem, merit


@dataclass(kw_only=True, eq=False)
class _State:
    """A choice of columns, and for each column the weighted value that it adds or would add."""

    cover: Cover
    covered: Rows
    chosen: np.ndarray
    scores: np.ndarray
    weights: np.ndarray
    changed: Columns
    """Time at which each column was last chosen or removed."""
    cost: int | float = 0.0
    time: int = 0
    banned: set[int] = field(default_factory=set)
    """Columns removed in this step, which must not be chosen again in it."""

    def entries(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Column, row and value of all entries of some rows."""
        starts = self.cover.matrix.indptr[rows]
        lengths = self.cover.matrix.indptr[rows + 1] - starts
        place = np.repeat(starts - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
        place += np.arange(len(place))
        of_entry = np.repeat(rows, lengths)
        return self.cover.matrix.indices[place], of_entry, self.cover.matrix.data[place]

    def values(self, columns: np.ndarray, rows: np.ndarray, data: np.ndarray) -> np.ndarray:
        """The value that entries add to their rows, capped at the needs: a loss if chosen, else a gain."""
        needs, covered = self.cover.needs[rows], self.covered[rows]
        without = np.where(self.chosen[columns], covered - data, covered)
        return np.minimum(without + data, needs) - np.minimum(without, needs)

    def flip(self, column: int) -> None:
        """Choose a column, or remove it."""
        rows, data = self.cover.rows_of(column)
        sign = -1 if self.chosen[column] else 1
        before = self.covered[rows]
        needs = self.cover.needs[rows]
        matters = np.minimum(before, before + sign * data) < 2 * needs
        near = self.entries(rows[matters])
        old = self.values(*near)
        self.covered[rows] = before + sign * data
        self.chosen[column] = not self.chosen[column]
        np.add.at(self.scores, near[0], self.weights[near[1]] * (self.values(*near) - old))
        self.cost += sign * float(self.cover.costs[column])
        self.changed[column] = self.time

    def unmet(self) -> np.ndarray:
        """Rows whose needs are not met."""
        return np.flatnonzero(self.covered < self.cover.needs)

    def weigh(self, rows: np.ndarray) -> None:
        """Increase the weights of rows that remain unmet."""
        self.weights[rows] += 1
        near = self.entries(rows)
        np.add.at(self.scores, near[0], self.values(*near))

    def cheapest_loss(self) -> int:
        """The chosen column of least value for its cost; among equals the one chosen longest ago."""
        columns = np.flatnonzero(self.chosen)
        ratios = self.scores[columns] / self.cover.costs[columns]
        best = columns[ratios == ratios.min()]
        return int(best[np.argmin(self.changed[best])])

    def best_gain(self, row: int, room: int | float) -> int | None:
        """The column of a row that adds the most for its cost, among those that fit and are not banned."""
        part = slice(self.cover.matrix.indptr[row], self.cover.matrix.indptr[row + 1])
        columns = self.cover.matrix.indices[part]
        fits = ~self.chosen[columns] & (self.cover.costs[columns] <= room)
        columns = np.array([c for c in columns[fits].tolist() if c not in self.banned], dtype=np.int64)
        if len(columns) == 0:
            return None
        ratios = self.scores[columns] / self.cover.costs[columns]
        best = columns[ratios == ratios.max()]
        return int(best[np.argmin(self.changed[best])])


def improved(cover: Cover, chosen: list[int], *, bound: int | float, steps: int, seed: int) -> list[int]:
    """Search for a better choice than a given one by weighted swaps [1].

    When all rows are met, columns are removed until the choice is cheaper. Then each step removes the column
    whose loss matters least, chooses the best columns of random unmet rows while they fit into the cost, and
    adds 1 to the weights of the rows that are still unmet.

    Args:
        cover: The rows to meet, within its budget if it has one.
        chosen: A choice to start from, within the budget; without one it meets all rows.
        bound: Lower bound on the cost of choices that meet all rows; the search ends when it is reached.
        steps: Number of swaps to try.
        seed: Equal arguments give equal results.

    Returns:
        The best choice found, ascending: fewest unmet rows, then lowest cost.

    References:
        [1] Gao, Weise and Li, An efficient local search heuristic with row weighting for the unicost set
            covering problem, European Journal of Operational Research 246, 2015.
    """
    rng = np.random.default_rng(seed)
    state = _start(cover, chosen)
    best, best_merit = sorted(chosen), (len(state.unmet()), state.cost)
    limit = cover.budget * (1 + 1e-12)
    for step in range(steps):
        unmet = state.unmet()
        if (len(unmet), state.cost) < best_merit:
            best, best_merit = np.flatnonzero(state.chosen).tolist(), (len(unmet), state.cost)
        if len(unmet) == 0:
            limit = min(limit, state.cost * (1 - 1e-9))
        proven = best_merit[0] == 0 and best_merit[1] - bound < 1e-9 * best_merit[1]
        if proven or not state.chosen.any():
            break
        state.time = step + 1
        _swap(state, limit, rng)
    return best


def _swap(state: _State, limit: int | float, rng: np.random.Generator) -> None:
    state.banned.clear()
    while True:
        column = state.cheapest_loss()
        state.flip(column)
        state.banned.add(column)
        if state.cost <= limit or not state.chosen.any():
            break
    unmet = state.unmet()
    while len(unmet) > 0:
        column = state.best_gain(int(unmet[rng.integers(len(unmet))]), limit - state.cost)
        if column is None:
            break
        state.flip(column)
        unmet = state.unmet()
    state.weigh(unmet)


def _start(cover: Cover, chosen: list[int]) -> _State:
    m, n = len(cover.needs), len(cover.costs)
    state = _State(
        cover=cover,
        covered=cover.covered(chosen),
        chosen=np.zeros(n, dtype=bool),
        scores=np.zeros(n),
        weights=np.ones(m),
        changed=np.zeros(n, dtype=np.int64),
        cost=float(cover.costs[chosen].sum()),
    )
    state.chosen[chosen] = True
    columns, rows, data = state.entries(np.arange(m))
    np.add.at(state.scores, columns, state.values(columns, rows, data).astype(float))
    return state


_MOST_ROUNDS = 10
_ENTRIES = 150_000_000  # of the adjacency, evaluated by all rounds together


def least_error_by_swaps(problem: DominationProblem, chosen: tuple[int, ...]) -> tuple[int, ...]:
    """Swap chosen nodes for others while that reduces the total error and makes nothing else worse.

    A round tries the best replacement of each chosen node, in ascending order. Rounds end when no swap helps,
    or after ten rounds, or fewer on large graphs, but at least one.

    Args:
        problem: A problem with errors.
        chosen: A feasible set, ascending.

    Returns:
        A set that is not worse in number unmet, then cost, then error.
    """
    entries_a_round = max(1, len(chosen) * problem.adjacency.nnz)
    for _ in range(max(1, min(_MOST_ROUNDS, _ENTRIES // entries_a_round))):
        before = chosen
        for node in before:
            chosen = _swapped(problem, chosen, node)
        if chosen == before:
            break
    return chosen


def _swapped(problem: DominationProblem, chosen: tuple[int, ...], node: int) -> tuple[int, ...]:
    """The set with the node swapped for its best replacement if that is better, else the same set."""
    rest = np.array([other for other in chosen if other != node], dtype=np.int64)
    others, num_met = _replacements(problem, rest, node)
    if len(others) == 0:
        return chosen
    order = np.lexsort((others, _changes(problem, rest, others), problem.costs[others], -num_met))
    swapped = tuple(sorted([*rest.tolist(), int(others[order[0]])]))
    return swapped if merit(problem, swapped) < merit(problem, chosen) else chosen


def _replacements(problem: DominationProblem, rest: np.ndarray, node: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes at no greater cost that meet at least as many unmet requirements, and how many each meets."""
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
    others = np.flatnonzero(allowed & (num_met >= num_met[node]))
    return others, num_met[others]


def _changes(problem: DominationProblem, rest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Change of the total error when each of some nodes joins the rest."""
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
