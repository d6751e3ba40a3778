"""The best dominating set, by integer programming."""

import numpy as np
from scipy.optimize import Bounds, milp

from slimsfm.domination.problem import DominationProblem
from slimsfm.domination.program import Minimum, Program
from slimsfm.domination.solution import Solution
from slimsfm.domination.stages import solve_in_stages


def exact(problem: DominationProblem, *, time_limit_s: float = 60.0, seed: int = 0) -> Solution:
    """Find a best dominating set of a directed graph and prove that none is better.

    A covering program: minimize the cost of binary x such that each node's requirement, a linear inequality,
    is met. Data reduction and the split into components come first; HiGHS [2] solves what is left by branch
    and cut. With a budget or errors there are further programs, one for each aim, with the earlier aims held;
    the one for the errors is that of the p-median problem. The problem is NP-hard; view graphs [1] of some
    hundred images take seconds.

    Args:
        problem: What to meet.
        time_limit_s: Seconds after which the search ends with the best set so far. What precedes the
            programs, `greedy` included, takes part of it, but is not cut off.
        seed: Seed of `greedy`, from whose set the search starts.

    Returns:
        A best set (`is_optimal`), up to 1e-6 in sums of costs or errors that are not whole numbers; or, if
        the time is up, one that is no worse than `greedy`'s, with the search's bounds. Which of several best
        sets it is, HiGHS settles, a deterministic search; only one that the clock cuts off is not repeatable.

    Raises:
        ValueError: `time_limit_s` is not positive.

    References:
        [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set.
        [2] Huangfu and Hall, Parallelizing the dual revised simplex method, Mathematical Programming
            Computation 10, 2018.
    """
    return solve_in_stages(problem, _minimize, time_limit_s=time_limit_s, seed=seed)


def _minimize(program: Program, hint: np.ndarray, seconds: float) -> Minimum:  # noqa: ARG001 - milp takes none
    if len(program.objective) == 0:
        return Minimum(values=np.zeros(0), bound=0.0)
    result = milp(
        program.objective,
        integrality=np.ones(len(program.objective)),
        bounds=Bounds(*np.stack([program.least, program.most])),
        constraints=(program.matrix.tocsc(), program.lower, np.inf),
        options={"time_limit": seconds, "mip_rel_gap": 0.0},
    )
    bound = result.fun if result.status == 0 else result.mip_dual_bound
    return Minimum(
        values=result.x, bound=float(bound) if bound is not None and np.isfinite(bound) else -np.inf
    )
