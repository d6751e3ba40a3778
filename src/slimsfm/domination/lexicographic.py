"""Integer programs of domination, and lexicographic minimization: one objective after the other."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import block_array, csr_array, diags_array, hstack, vstack

from slimsfm.domination.cover import Columns, Cover, Rows, components, cover_of, presolve, split
from slimsfm.domination.greedy_cover import LARGE, greedy, greedy_parts, part_bound
from slimsfm.domination.problem import (
    TOLERANCE,
    Bounds,
    DominationProblem,
    Solution,
    merit,
    rounded_up,
    solution_of,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Program:
    """Minimize c x over 0-1 vectors x between two others, with A x >= b."""

    objective: np.ndarray
    """Vector c."""

    matrix: csr_array
    """Matrix A."""

    lower: np.ndarray
    """Vector b."""

    least: np.ndarray
    """Least value of each variable, 0 or 1."""

    most: np.ndarray
    """Largest value of each variable, 0 or 1."""

    def aiming_at(self, objective: np.ndarray) -> "Program":
        """The program with another objective."""
        return replace(self, objective=objective)

    def holding(self, value: int | float) -> "Program":
        """The program with the constraint that its objective is at most a value."""
        limit = value + TOLERANCE * max(1.0, abs(value))
        row = csr_array(-self.objective[None])
        return replace(
            self,
            matrix=csr_array(vstack([self.matrix, row], format="csr")),
            lower=np.append(self.lower, -limit),
        )

    def extended(self, old: csr_array, new: csr_array, lower: np.ndarray, costs: np.ndarray) -> "Program":
        """The program with more variables of given costs, and the constraints old x + new y >= lower."""
        count = len(costs)
        return Program(
            objective=np.concatenate([self.objective, costs]),
            matrix=csr_array(block_array([[self.matrix, None], [old, new]], format="csr")),
            lower=np.concatenate([self.lower, lower]),
            least=np.concatenate([self.least, np.zeros(count)]),
            most=np.concatenate([self.most, np.ones(count)]),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Minimum:
    """The result of minimizing a program."""

    values: np.ndarray | None
    """The best feasible vector found, or None."""

    bound: int | float
    """Lower bound: no feasible vector has a smaller objective."""


Minimizer = Callable[[Program, np.ndarray, float], Minimum]
"""Minimizes a program, given the first variables of a good vector and a time limit in seconds."""


def covering_program(cover: Cover) -> Program:
    """The program of the cheapest choice for a cover without a budget, one variable per candidate."""
    columns = cover.candidates
    return Program(
        objective=cover.costs[columns],
        matrix=csr_array(cover.matrix[:, columns], dtype=np.float64),
        lower=cover.needs.astype(np.float64),
        least=np.zeros(len(columns)),
        most=np.ones(len(columns)),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class StagedProgram:
    """The program of a part of a problem, without its last objective, the total error.

    The first variables say whether each node of the part is chosen; under a budget, further variables say
    whether each requirement is met.
    """

    nodes: Columns
    """The nodes of the part."""

    rows: Rows
    """The requirements of the part that are positive."""

    program: Program
    """All constraints; the objective is zero."""

    unmet: np.ndarray
    """The objective that is minus the number of requirements met."""

    cost: np.ndarray
    """The objective that is the cost of the chosen nodes."""


def staged_program(problem: DominationProblem, rows: Rows) -> StagedProgram:
    """The program of some requirements of a problem that share no node with the others."""
    nodes = rows[rows < problem.num_nodes]
    matrix, needs = problem.requirements
    open_rows = rows[needs[rows] > 0]
    of_nodes = csr_array(matrix[open_rows][:, nodes], dtype=np.float64)
    lower = needs[open_rows].astype(np.float64)
    costs = problem.costs[nodes]
    num_met = 0
    if problem.budget is not None:
        num_met = len(open_rows)
        paid = csr_array(-np.append(costs, np.zeros(num_met))[None])
        of_nodes = csr_array(vstack([hstack([of_nodes, _diagonal(-lower)]), paid], format="csr"))
        lower = np.append(np.zeros(num_met), -problem.budget * (1 + TOLERANCE))
    count = len(nodes) + num_met
    return StagedProgram(
        nodes=nodes,
        rows=open_rows,
        program=Program(
            objective=np.zeros(count),
            matrix=of_nodes,
            lower=lower,
            least=np.zeros(count),
            most=np.ones(count),
        ),
        unmet=np.append(np.zeros(len(nodes)), -np.ones(num_met)),
        cost=np.append(costs, np.zeros(num_met)),
    )


def error_program(
    problem: DominationProblem, errors: csr_array, staged: StagedProgram, program: Program
) -> Program:
    """A staged program that minimizes the total error: the p-median program [1].

    One more variable per edge says that its target, which is met but not chosen, counts with this error. Only
    edges from chosen nodes can count.

    References:
        [1] ReVelle and Swain, Central facilities location, Geographical Analysis 2, 1970.
    """
    targets = staged.rows[staged.rows < problem.num_nodes]
    edges = csr_array(errors.T)[targets].tocoo()
    kept = edges.col != targets[edges.row]
    u, row, costs = edges.col[kept], edges.row[kept], edges.data[kept]
    old, count, number = len(program.objective), len(costs), np.arange(len(targets))
    own = _entries(number, np.searchsorted(staged.nodes, targets), (len(targets), old))
    asked = np.ones(len(targets))
    if problem.budget is not None:
        own = csr_array(own - _entries(number, len(staged.nodes) + number, (len(targets), old)))
        asked = np.zeros(len(targets))
    counted = _entries(row, np.arange(count), (len(targets), count))
    used = _entries(np.arange(count), np.searchsorted(staged.nodes, u), (count, old))
    return program.aiming_at(np.zeros(old)).extended(
        csr_array(vstack([own, used], format="csr")),
        csr_array(vstack([counted, -_diagonal(np.ones(count))], format="csr")),
        np.append(asked, np.zeros(count)),
        costs,
    )


def _entries(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> csr_array:
    return csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)


def _diagonal(values: np.ndarray) -> csr_array:
    return csr_array(diags_array(values, format="csr"))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """A problem, the minimizer of its programs, and a deadline."""

    problem: DominationProblem
    minimize: Minimizer
    deadline: float
    seed: int
    effort: int

    def minimum(self, program: Program, hint: np.ndarray) -> Minimum:
        """The minimum, or the best result when the time is up."""
        seconds = self.deadline - perf_counter()
        if seconds <= 0:
            return Minimum(values=None, bound=-np.inf)
        return self.minimize(program, hint, seconds)

    def relaxation(self, program: Program) -> int | float:
        """The least objective over the reals: a bound that the search over integers may find slowly."""
        result = linprog(
            program.objective,
            A_ub=-program.matrix.tocsc(),
            b_ub=-program.lower,
            bounds=np.stack([program.least, program.most], axis=1),
            method="highs-ipm",
            options={"time_limit": max(self.deadline - perf_counter(), 1e-3)},
        )
        return float(result.fun) if result.status == 0 else 0.0

    def best(self, *sets: tuple[int, ...]) -> tuple[int, ...]:
        """The best feasible one of some sets; the first among equals."""
        kept = [chosen for chosen in dict.fromkeys(sets) if self.problem.satisfies(chosen)]
        return min(kept, key=lambda chosen: merit(self.problem, chosen))


def solve_in_stages(
    problem: DominationProblem, minimize: Minimizer, *, time_limit_s: float, seed: int, effort: int = 1
) -> Solution:
    """Minimize the number unmet, then the cost, then the error, each with the earlier ones fixed.

    The search starts from the choices of `greedy` and never returns a worse one. Without a budget nothing is
    unmet, and costs are minimized on the reduced problem, component by component.

    Raises:
        ValueError: `time_limit_s` is not positive.
    """
    if not time_limit_s > 0:
        raise ValueError(f"time_limit_s must be positive, got {time_limit_s}")
    start = perf_counter()
    search = _Search(
        problem=problem, minimize=minimize, deadline=start + time_limit_s, seed=seed, effort=effort
    )
    chosen, bounds = _cheapest(search) if problem.budget is None else _most_met(search)
    found = solution_of(problem, chosen, bounds, start)
    if problem.errors is None or found.unmet > found.unmet_bound or found.gap > 0:
        return found
    chosen, error_bound = _least_error(search, problem.errors, chosen)
    bounds = Bounds(unmet=bounds.unmet, cost=bounds.cost, error=error_bound)
    return solution_of(problem, chosen, bounds, start)


def _cheapest(search: _Search) -> tuple[tuple[int, ...], Bounds]:
    problem = search.problem
    presolved = presolve(cover_of(problem))
    picked = list(presolved.chosen)
    bound = problem.cost(picked)
    pieces = sorted(split(presolved.cover), key=lambda piece: piece.matrix.nnz)
    hints = greedy_parts(pieces, seed=search.seed, effort=search.effort)
    for piece, hint in zip(pieces, hints, strict=True):
        part, least = _cheapest_part(search, piece, hint)
        picked += part
        bound += least
    sets = [tuple(sorted(picked))]
    if problem.errors is not None:
        sets.append(greedy(problem, seed=search.seed).chosen)
    return search.best(*sets), Bounds(cost=bound)


def _cheapest_part(search: _Search, piece: Cover, hint: list[int]) -> tuple[list[int], int | float]:
    """The cheapest choice found for a piece, and a bound on what any costs."""
    whole = search.problem.whole_costs
    bound, cost = part_bound(piece, whole=whole), float(piece.costs[hint].sum())
    if bound >= cost:
        return hint, bound
    columns, program = piece.candidates, covering_program(piece)
    relaxed = search.relaxation(program) if len(piece.needs) > LARGE else 0.0
    found = search.minimum(program, np.isin(columns, hint))
    least = max(relaxed, found.bound)
    bound = max(bound, rounded_up(least) if whole else least)
    if found.values is None:
        return hint, bound
    part = columns[found.values > 0.5].tolist()
    meets = bool(np.all(piece.covered(part) >= piece.needs))
    return (part if meets and piece.costs[part].sum() < cost else hint), bound


def _most_met(search: _Search) -> tuple[tuple[int, ...], Bounds]:
    problem = search.problem
    known = greedy(problem, seed=search.seed).chosen
    staged = staged_program(problem, np.arange(len(problem.requirements[1])))
    chosen, least = _improved(search, staged, staged.program.aiming_at(staged.unmet), known)
    unmet_bound = max(0, rounded_up(least + len(staged.rows)))
    if problem.num_unmet(chosen) > unmet_bound:
        return chosen, Bounds(unmet=unmet_bound)
    held = staged.program.aiming_at(staged.unmet).holding(unmet_bound - len(staged.rows))
    chosen, least = _improved(search, staged, held.aiming_at(staged.cost), chosen)
    return chosen, Bounds(unmet=unmet_bound, cost=max(least, 0))


def _least_error(
    search: _Search, errors: csr_array, chosen: tuple[int, ...]
) -> tuple[tuple[int, ...], int | float]:
    """The set of least total error among sets of equal cost that meet equally much, and a bound."""
    problem = search.problem
    rows = np.arange(len(problem.requirements[1]))
    parts = components(problem.requirements[0]) if problem.budget is None else [rows]
    total = 0.0
    for part in [part for part in parts if len(part) > 1]:
        staged = staged_program(problem, part)
        held = _held(problem, staged, chosen)
        program = error_program(problem, errors, staged, held)
        chosen, bound = _improved(search, staged, program, chosen)
        total += max(0.0, bound)
    return chosen, total


def _held(problem: DominationProblem, staged: StagedProgram, chosen: tuple[int, ...]) -> Program:
    """The staged program with the number met and the cost of a set as constraints."""
    cost = float(staged.cost[: len(staged.nodes)] @ np.isin(staged.nodes, chosen))
    program = staged.program.aiming_at(staged.cost).holding(cost)
    if problem.budget is None:
        return program
    met = len(staged.rows) - problem.num_unmet(chosen)
    return program.aiming_at(staged.unmet).holding(-met)


def _improved(
    search: _Search, staged: StagedProgram, program: Program, chosen: tuple[int, ...]
) -> tuple[tuple[int, ...], int | float]:
    """A set, or a better one with the part's nodes from the minimum of a program; and the bound."""
    hint = np.isin(staged.nodes, chosen)
    found = search.minimum(program, hint)
    if found.values is None:
        return chosen, found.bound
    part = staged.nodes[found.values[: len(staged.nodes)] > 0.5]
    others = sorted(set(chosen) - set(staged.nodes.tolist()))
    return search.best(chosen, tuple(sorted([*others, *part.tolist()]))), found.bound
