"""The integer program of all that a problem asks for, aim by aim."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array, hstack, vstack

from slimsfm.domination.cover import Columns, Rows
from slimsfm.domination.problem import TOLERANCE, DominationProblem
from slimsfm.domination.program import Program


@dataclass(frozen=True, kw_only=True, eq=False)
class StagedProgram:
    """A part of a problem, without its last aim: the total error.

    Its variables are first the part's nodes, whether each is chosen; then, under a budget, its requirements,
    whether each is met.
    """

    nodes: Columns
    """The nodes of the part."""

    rows: Rows
    """The part's requirements that ask for something."""

    program: Program
    """All constraints; the objective is zero."""

    unmet: np.ndarray
    """The objective that is minus the number of requirements met."""

    cost: np.ndarray
    """The objective that is the cost of the chosen nodes."""


def staged_program(problem: DominationProblem, rows: Rows) -> StagedProgram:
    """The program of some of a problem's requirements that have no node in common with the others."""
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
            least=np.append(np.isin(nodes, problem.forced_in).astype(np.float64), np.zeros(num_met)),
            most=np.append(~np.isin(nodes, problem.forced_out), np.ones(num_met)).astype(np.float64),
        ),
        unmet=np.append(np.zeros(len(nodes)), -np.ones(num_met)),
        cost=np.append(costs, np.zeros(num_met)),
    )


def error_program(
    problem: DominationProblem, errors: csr_array, staged: StagedProgram, program: Program
) -> Program:
    """A staged program that minimizes the total error: the p-median program [1].

    A variable more for each edge says that its target, being met but not chosen, counts with its error. Only
    edges from chosen nodes can be counted with.

    References:
        [1] ReVelle and Swain, Central facilities location, Geographical Analysis 2, 1970.
    """
    targets = staged.rows[staged.rows < problem.num_nodes]
    edges = csr_array(errors.T)[targets].tocoo()
    kept = (edges.col != targets[edges.row]) & ~np.isin(edges.col, problem.forced_out)
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
