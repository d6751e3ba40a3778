"""Solvers that prove their sets best: HiGHS, and CP-SAT for thousands of nodes."""

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import Bounds, milp

from slimsfm.domination.lexicographic import Minimum, Program, solve_in_stages
from slimsfm.domination.problem import DominationProblem, Solution
from slimsfm.errors import InputError

if TYPE_CHECKING:
    from ortools.sat.python import cp_model

_LARGEST = 2.0**40  # bound of the integers that other numbers are scaled to
_EFFORT = 6  # times the swaps of `greedy`


def exact(problem: DominationProblem, *, time_limit_s: float = 60.0, seed: int = 0) -> Solution:
    """Find a best dominating set of a directed graph and prove that none is better.

    A covering program: minimize the cost of binary x such that the requirement of each node, a linear
    inequality, is met. After data reduction and the split into components, HiGHS [2] solves the rest by
    branch and cut. With a budget or errors there is one program per objective, with the earlier objectives as
    constraints; the program of the errors is that of the p-median problem. The problem is NP-hard; view
    graphs [1] of some hundred images take seconds.

    Args:
        problem: The graph and its requirements.
        time_limit_s: Seconds after which the search ends with the best set so far. The steps before the
            programs, such as `greedy`, count toward it, but are not interrupted.
        seed: Seed of `greedy`, from whose set the search starts.

    Returns:
        A best set (`is_optimal`), up to 1e-6 in sums of costs or errors that are not integers; or, if the
        time is up, a set that is not worse than that of `greedy`, with the bounds of the search. The search
        is deterministic unless the time limit ends it.

    Raises:
        ValueError: `time_limit_s` is not positive.

    References:
        [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set.
        [2] Huangfu and Hall, Parallelizing the dual revised simplex method, Mathematical Programming
            Computation 10, 2018.
    """
    return solve_in_stages(problem, _minimize_highs, time_limit_s=time_limit_s, seed=seed)


def _minimize_highs(program: Program, hint: np.ndarray, seconds: float) -> Minimum:  # noqa: ARG001 - milp takes none
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


def cpsat(problem: DominationProblem, *, time_limit_s: float = 60.0, seed: int = 0) -> Solution:
    """Find a best dominating set of a directed graph, or a good one of a large graph, with a bound.

    The programs of `exact`, solved by CP-SAT [1]: clause learning with a linear relaxation. It starts from
    the set of `greedy`, with several times as many swaps for large components. One worker with the strongest
    relaxation proves more than several workers without it.

    Args:
        problem: The graph and its requirements.
        time_limit_s: Seconds after which the search ends with the best set so far. The steps before the
            programs, such as the swaps, count toward it, but are not interrupted.
        seed: Seed of the swaps and of CP-SAT.

    Returns:
        A best set (`is_optimal`); or, if the time is up, a set that is not worse than that of `greedy`, with
        the bounds of the search. Costs and errors that are not integers are rounded to a part in 10^12 of the
        largest. Equal problems and seeds give equal solutions unless the time limit ends the search.

    Raises:
        ValueError: `time_limit_s` is not positive.
        InputError: OR-Tools is not installed.

    References:
        [1] Perron, Didier and Gay, The CP-SAT-LP solver, CP 2023.
    """
    try:
        import ortools.sat.python.cp_model  # noqa: F401 - an extra: checked before any work is done
    except ImportError as error:
        raise InputError(
            "The solver cpsat needs OR-Tools, which is not installed: pip install 'slimsfm[cpsat]'"
        ) from error

    def minimize(program: Program, hint: np.ndarray, seconds: float) -> Minimum:
        return _minimize_cpsat(program, hint, seconds, seed)

    return solve_in_stages(problem, minimize, time_limit_s=time_limit_s, seed=seed, effort=_EFFORT)


def _minimize_cpsat(program: Program, hint: np.ndarray, seconds: float, seed: int) -> Minimum:
    from ortools.sat.python import cp_model

    if len(program.objective) == 0:
        return Minimum(values=np.zeros(0), bound=0.0)
    model = cp_model.CpModel()
    variables = [model.new_bool_var("") for _ in program.objective]
    _constrain(model, variables, program)
    scale = _scale(program.objective)
    rounded_down = np.floor(program.objective * scale).astype(np.int64)
    model.minimize(cp_model.LinearExpr.weighted_sum(variables, rounded_down.tolist()))
    for variable, value in zip(variables, hint.tolist(), strict=False):
        model.add_hint(variable, value)
    solver = cp_model.CpSolver()
    solver.parameters.num_workers = 1
    solver.parameters.linearization_level = 2
    solver.parameters.random_seed = seed % 2**31
    solver.parameters.max_time_in_seconds = seconds
    status = solver.solve(model)
    if status not in (cp_model.OPTIMAL, cp_model.FEASIBLE, cp_model.UNKNOWN):
        return Minimum(values=None, bound=-np.inf)
    bound = solver.best_objective_bound / scale
    if status == cp_model.UNKNOWN:
        return Minimum(values=None, bound=bound)
    return Minimum(values=np.array([solver.value(variable) for variable in variables], float), bound=bound)


def _constrain(model: "cp_model.CpModel", variables: list, program: Program) -> None:
    from ortools.sat.python import cp_model

    for place in np.flatnonzero(program.least == program.most).tolist():
        model.add(variables[place] == int(program.least[place]))
    matrix = program.matrix
    for row, lower in enumerate(program.lower.tolist()):
        part = slice(matrix.indptr[row], matrix.indptr[row + 1])
        members = [variables[column] for column in matrix.indices[part].tolist()]
        values = matrix.data[part]
        if lower == 1 and np.all(values == 1):
            model.add_at_least_one(members)
            continue
        scale = _scale(values)
        rounded = np.floor(values * scale).astype(np.int64)
        total = cp_model.LinearExpr.weighted_sum(members, rounded.tolist())
        model.add(total >= int(np.ceil(lower * scale)))


def _scale(values: np.ndarray) -> float:
    """A power of two that makes values integers or, if no moderate one does, large."""
    largest = np.abs(values).max(initial=1.0)
    scale = 1.0
    while np.any(values * scale != np.floor(values * scale)) and largest * scale < _LARGEST:
        scale *= 2
    return scale
