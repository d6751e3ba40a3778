"""The smallest dominating set, by integer programming."""

from math import ceil

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, OptimizeResult, milp
from scipy.sparse import csc_array

from slimsfm.domination.problem import DominationProblem, Solution
from slimsfm.domination.random_greedy import random_greedy

_BOUND_TOLERANCE = 1e-6


def exact(problem: DominationProblem, *, time_limit_s: float = 60.0, seed: int = 0) -> Solution:
    """Find a smallest dominating set of a directed graph and prove that none is smaller.

    A set cover: minimize sum(x) over binary x such that the dominators of each node, itself among them, sum
    up to 1 or more. HiGHS [2] solves it by branch and cut. The problem is NP-hard; view graphs [1] of some
    hundred images take seconds.

    Args:
        problem: The graph.
        time_limit_s: Seconds after which the search ends with the best set so far.
        seed: Seed of `random_greedy`, which is asked when the time is up. Its draws come on top of the limit.

    Returns:
        A smallest dominating set (`is_optimal`); or, if the time is up, the smaller of the search's and
        `random_greedy`'s, the search's if equal, with the search's lower bound. Which of several smallest
        sets it is, HiGHS settles, a deterministic search; only one that the clock cuts off is not repeatable.

    Raises:
        ValueError: `time_limit_s` is not positive.

    References:
        [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set.
        [2] Huangfu and Hall, Parallelizing the dual revised simplex method, Mathematical Programming
            Computation 10, 2018.
    """
    if not time_limit_s > 0:
        raise ValueError(f"time_limit_s must be positive, got {time_limit_s}")
    if problem.num_nodes == 0:
        return Solution(chosen=(), lower_bound=0)
    result = _solve_set_cover(problem, time_limit_s)
    found = _incumbent(result)
    bound = max(_integer_bound(result), problem.degree_bound)
    if found is not None and len(found) == bound:
        return Solution(chosen=found, lower_bound=bound)
    drawn = random_greedy(problem, seed=seed).chosen
    best = drawn if found is None or len(drawn) < len(found) else found
    return Solution(chosen=best, lower_bound=bound)


def _solve_set_cover(problem: DominationProblem, time_limit_s: float) -> OptimizeResult:
    dominators = csc_array(problem.adjacency.T, dtype=np.float64)
    return milp(
        np.ones(problem.num_nodes),
        integrality=np.ones(problem.num_nodes),
        bounds=Bounds(0, 1),
        constraints=LinearConstraint(dominators, lb=1),
        options={"time_limit": time_limit_s, "mip_rel_gap": 0.0},
    )


def _incumbent(result: OptimizeResult) -> tuple[int, ...] | None:
    """The best set found, or None when the time was up before there was one."""
    return None if result.x is None else tuple(np.flatnonzero(result.x > 0.5).tolist())


def _integer_bound(result: OptimizeResult) -> int:
    """The dual bound, rounded up since sizes are whole numbers; 0 where there is none yet."""
    bound = result.mip_dual_bound
    return ceil(bound - _BOUND_TOLERANCE) if bound is not None and np.isfinite(bound) else 0
