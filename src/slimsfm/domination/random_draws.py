"""The solver of the paper: the best of many random maximal choices."""

from time import perf_counter

import numpy as np

from slimsfm.arrays import Ids
from slimsfm.domination.cover import cover_of, dual_bound
from slimsfm.domination.problem import DominationProblem
from slimsfm.domination.solution import Bounds, Solution, merit, solution_of


def random_greedy(problem: DominationProblem, *, draws: int = 1000, seed: int = 0) -> Solution:
    """Find a small dominating set by drawing many at random.

    Algorithm 2 of [1]: choose a random remaining node and remove it and its out-neighbors, until none
    remains. The best of all draws wins, the first found among equals.

    Beyond [1], a node remains until its requirement is met, and random members of a group are chosen until
    the group has one. Under a budget a node that no longer fits is skipped.

    Args:
        problem: The graph and its requirements.
        draws: Number of sets that are drawn; 1000 in [1].
        seed: Equal problems, draws and seeds give equal solutions.

    Returns:
        A dominating set. Its lower bound on the cost is that of a packing of the nodes; it is rarely tight,
        so optimality is rarely proven. Under a budget there is no bound.

    Raises:
        ValueError: `draws` is not positive.

    Notes:
        A draw takes time linear in nodes and edges. It never chooses a node that an earlier choice dominates,
        which a smallest set may need: there are graphs whose smallest sets no number of draws finds.

    References:
        [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set.
    """
    if draws < 1:
        raise ValueError(f"draws must be positive, got {draws}")
    start = perf_counter()
    rng = np.random.default_rng(seed)
    drawn = _Draws(problem)
    sets = (drawn.draw(rng) for _ in range(draws))
    if problem.budget is None and problem.errors is None:
        best = min(sets, key=lambda chosen: float(problem.costs[chosen].sum()))
    else:
        best = min(sets, key=lambda chosen: merit(problem, tuple(sorted(chosen))))
    bound = dual_bound(drawn.cover) if problem.budget is None else 0
    return solution_of(problem, tuple(sorted(best)), Bounds(cost=bound), start)


class _Draws:
    """A problem prepared for many draws."""

    def __init__(self, problem: DominationProblem) -> None:
        self.problem = problem
        self.cover = cover_of(problem)
        columns, matrix = self.cover.columns, self.cover.matrix
        self.rows = np.split(columns.indices, columns.indptr[1:-1])
        self.values = np.split(columns.data, columns.indptr[1:-1])
        self.members = np.split(matrix.indices, matrix.indptr[1:-1])
        self.own = _own_nodes(problem).tolist()

    def draw(self, rng: np.random.Generator) -> list[int]:
        """Visit the rows in random order: each is a uniform choice among the remaining ones."""
        residual = self.cover.needs.copy()
        chosen: list[int] = []
        left = self.cover.budget * (1 + 1e-12)
        for row in rng.permutation(len(residual)).tolist():
            if residual[row] <= 0:
                continue
            own = self.own[row]
            for node in [own] if own >= 0 else self._others(row, chosen, rng):
                if residual[row] > 0 and self.cover.costs[node] <= left:
                    chosen.append(node)
                    left -= self.cover.costs[node]
                    residual[self.rows[node]] -= self.values[node]
        return chosen

    def _others(self, row: int, chosen: list[int], rng: np.random.Generator) -> list[int]:
        """The members of a group that are not chosen, in random order."""
        members = np.setdiff1d(self.members[row], chosen)
        return rng.permutation(members).tolist()


def _own_nodes(problem: DominationProblem) -> Ids:
    """The node of each row of the problem's cover; -1 for groups."""
    _, needs = problem.requirements
    nodes = np.full(len(needs), -1, dtype=np.int64)
    nodes[: problem.num_nodes] = np.arange(problem.num_nodes)
    return nodes[needs > 0]
