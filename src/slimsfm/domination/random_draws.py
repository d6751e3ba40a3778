"""The paper's solver: the best of many random maximal choices."""

from time import perf_counter

import numpy as np

from slimsfm.arrays import Ids
from slimsfm.domination.cover import cover_of, dual_bound
from slimsfm.domination.problem import DominationProblem
from slimsfm.domination.solution import Bounds, Solution, merit, solution_of


def random_greedy(problem: DominationProblem, *, draws: int = 1000, seed: int = 0) -> Solution:
    """Find a small dominating set by drawing many at random.

    Algorithm 2 of [1]: choose a random node of the remaining ones, remove it and its out-neighbours, until
    none remains. The best of all draws wins, the first found among equals.

    Beyond [1], the nodes forced in come first, and a node remains until it has what it asks for. One that is
    forced out cannot be chosen; random ones of its in-neighbours are, until it has enough, and so it is with
    groups. Under a budget a node that no longer fits is passed over.

    Args:
        problem: What to meet.
        draws: How many sets are drawn; [1] takes 1000.
        seed: Equal problems, draws and seeds give equal solutions.

    Returns:
        A dominating set. Its lower bound on the cost is that of a packing of the nodes; it is seldom tight,
        and optimality seldom proven. Under a budget it is that of the nodes forced in.

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
    """A problem made ready for many draws."""

    def __init__(self, problem: DominationProblem) -> None:
        self.problem = problem
        self.cover = cover_of(problem)
        columns, matrix = self.cover.columns, self.cover.matrix
        self.rows = np.split(columns.indices, columns.indptr[1:-1])
        self.values = np.split(columns.data, columns.indptr[1:-1])
        self.members = np.split(matrix.indices, matrix.indptr[1:-1])
        self.own = _own_nodes(problem).tolist()

    def draw(self, rng: np.random.Generator) -> list[int]:
        """Walk through a random order: its next remaining node is a uniform choice of the remaining ones."""
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
        """Whom to choose for a row whose own node may not be chosen: its other members, at random."""
        members = np.setdiff1d(self.members[row], chosen)
        return rng.permutation(members).tolist()


def _own_nodes(problem: DominationProblem) -> Ids:
    """The node of each row of the problem's cover; -1 for nodes forced out and for groups."""
    _, needs = problem.requirements
    nodes = np.full(len(needs), -1, dtype=np.int64)
    nodes[: problem.num_nodes] = np.arange(problem.num_nodes)
    return nodes[needs > 0]
