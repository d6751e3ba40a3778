"""The paper's solver: the smallest of many random maximal choices."""

import numpy as np

from slimsfm.arrays import Ids
from slimsfm.domination.problem import DominationProblem, Solution


def random_greedy(problem: DominationProblem, *, draws: int = 1000, seed: int = 0) -> Solution:
    """Find a small dominating set by drawing many at random.

    Algorithm 2 of [1]: choose a random node of the remaining ones, remove it and its out-neighbours, until
    none remains. The smallest of all draws wins, the first found among equals.

    Args:
        problem: The graph.
        draws: How many sets are drawn; [1] takes 1000.
        seed: Equal problems, draws and seeds give equal solutions.

    Returns:
        A dominating set. Its lower bound is the number of nodes over the most that a single node dominates,
        rounded up; so it is seldom tight, and optimality seldom proven.

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
    rng = np.random.default_rng(seed)
    adjacency = problem.adjacency
    dominated_by = np.split(adjacency.indices, adjacency.indptr[1:-1])
    orders = (rng.permutation(problem.num_nodes) for _ in range(draws))
    best = min((_draw(dominated_by, order) for order in orders), key=len)
    return Solution(chosen=tuple(sorted(best)), lower_bound=problem.degree_bound)


def _draw(dominated_by: list[np.ndarray], order: Ids) -> list[int]:
    """Walk through a random order: its next remaining node is a uniform choice of the remaining ones."""
    remaining = np.ones(len(order), dtype=bool)
    chosen = []
    for node in order.tolist():
        if remaining[node]:
            chosen.append(node)
            remaining[dominated_by[node]] = False
    return chosen
