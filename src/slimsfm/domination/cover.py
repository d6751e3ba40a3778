"""What is left of a problem once its forced nodes are settled: a covering problem."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Int64
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import connected_components

from slimsfm.domination.problem import DominationProblem

Rows = Int64[np.ndarray, " rows"]
"""Something of each row, or numbers of some rows."""

Columns = Int64[np.ndarray, " columns"]
"""Numbers of some columns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cover:
    """Choose columns of a matrix A of whole numbers so that each row i sums to its need b_i or more.

    Columns are the nodes of a problem, under their own numbers; those that may not be chosen, or need not be
    considered, are empty. No entry exceeds its row's need.
    """

    matrix: csr_array
    """A, one row for each requirement that is not met yet."""

    needs: Rows
    """b, positive."""

    costs: np.ndarray
    """Positive, one a column."""

    budget: int | float = np.inf
    """The largest sum of costs."""

    @cached_property
    def columns(self) -> csc_array:
        """A by columns."""
        columns = csc_array(self.matrix)
        columns.sort_indices()
        return columns

    @property
    def candidates(self) -> Columns:
        """Columns that are not empty."""
        return np.flatnonzero(np.diff(self.columns.indptr)).astype(np.int64)

    def rows_of(self, column: int) -> tuple[np.ndarray, np.ndarray]:
        """The rows and the values of a column's entries."""
        part = slice(self.columns.indptr[column], self.columns.indptr[column + 1])
        return self.columns.indices[part], self.columns.data[part]

    def covered(self, chosen: list[int]) -> Rows:
        """What chosen columns sum to in each row."""
        indicator = np.zeros(len(self.costs), dtype=np.int64)
        indicator[chosen] = 1
        return np.asarray(self.matrix @ indicator, dtype=np.int64)

    def after(self, chosen: list[int], without: np.ndarray) -> "Cover":
        """The cover that is left when columns are chosen and others (a mask) are given up."""
        needs = self.needs - self.covered(chosen)
        gone = without.copy()
        gone[chosen] = True
        return made(self.matrix, needs, self.costs, gone, self.budget)


def made(
    matrix: csr_array, needs: Rows, costs: np.ndarray, gone: np.ndarray, budget: int | float = np.inf
) -> Cover:
    """A cover of the rows that need something, without the columns that are gone (a mask)."""
    open_rows = np.flatnonzero(needs > 0)
    part = csr_array(matrix[open_rows], dtype=np.int64)
    left = needs[open_rows]
    of_entry = np.repeat(np.arange(len(open_rows)), np.diff(part.indptr))
    part.data = np.where(gone[part.indices], 0, np.minimum(part.data, left[of_entry]))
    part.eliminate_zeros()
    part.sort_indices()
    return Cover(matrix=part, needs=left, costs=costs, budget=budget)


def cover_of(problem: DominationProblem) -> Cover:
    """What is left to meet once the nodes forced in are chosen and those forced out are not."""
    matrix, needs = problem.requirements
    forced = list(problem.forced_in)
    indicator = np.zeros(problem.num_nodes, dtype=np.int64)
    indicator[forced] = 1
    budget = np.inf if problem.budget is None else problem.budget - problem.cost(forced)
    return made(matrix, needs - matrix @ indicator, problem.costs, indicator > 0, budget)


def components(matrix: csr_array) -> list[Rows]:
    """Rows of a matrix in groups that share no column, each ascending, ordered by their first rows."""
    m, n = (int(size) for size in matrix.shape or ())
    pattern = csr_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=(m, n))
    entries = pattern.tocoo()
    blocks = csr_array((entries.data, (entries.row, entries.col + m)), shape=(m + n, m + n))
    _, labels = connected_components(blocks, directed=False)
    order = np.argsort(labels[:m], kind="stable")
    starts = np.flatnonzero(np.diff(labels[:m][order])) + 1
    groups = [group.astype(np.int64) for group in np.split(order, starts) if len(group) > 0]
    return sorted(groups, key=lambda group: int(group[0]))


def split(cover: Cover) -> list[Cover]:
    """Covers without a common row or column, which can be solved apart; the cover must have no budget."""
    return [
        Cover(matrix=csr_array(cover.matrix[rows]), needs=cover.needs[rows], costs=cover.costs)
        for rows in components(cover.matrix)
    ]


def dual_bound(cover: Cover) -> int | float:
    """A cost below which no choice of columns meets all rows: that of a packing of the rows.

    Any prices y >= 0 of the rows, such that no column's rows are priced above its cost, prove sum(b y): weak
    duality of linear programming. Each row's price starts at the least share of a column's cost among the
    column's entries, then rises as far as it can, rows with the lowest prices first.
    """
    if cover.matrix.nnz == 0:
        return 0.0
    sums = np.maximum(np.asarray(cover.columns.sum(axis=0), dtype=np.float64).ravel(), 1)
    shares = (cover.costs / sums)[cover.matrix.indices]
    prices = np.minimum.reduceat(shares, cover.matrix.indptr[:-1])
    slack = cover.costs - cover.columns.T @ prices
    indptr, indices, data = cover.matrix.indptr, cover.matrix.indices, cover.matrix.data
    for row in np.argsort(prices, kind="stable").tolist():
        part = slice(indptr[row], indptr[row + 1])
        rise = max(0.0, float((slack[indices[part]] / data[part]).min()))
        slack[indices[part]] -= rise * data[part]
        prices[row] += rise
    return float(cover.needs @ prices)
