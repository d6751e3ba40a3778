"""Integer programs for covers and for all aims of a problem, to be minimized by any solver."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_array, csr_array, diags_array, hstack, vstack

from slimsfm.domination.cover import Columns, Cover, Rows
from slimsfm.domination.problem import TOLERANCE, DominationProblem


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
