"""The covering problem that a domination problem states, and its data reduction."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Int64
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import connected_components

from slimsfm.domination.problem import DominationProblem

Rows = Int64[np.ndarray, " rows"]
"""One value per row, or indices of rows."""

Columns = Int64[np.ndarray, " columns"]
"""Indices of columns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cover:
    """Choose columns of an integer matrix A so that each row i sums to its need b_i or more.

    Columns are the nodes of a problem, with the same indices; columns that need not be considered are empty.
    No entry exceeds its row's need.
    """

    matrix: csr_array
    """A, with one row per unmet requirement."""

    needs: Rows
    """b, positive."""

    costs: np.ndarray
    """Positive, one per column."""

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
        """The sum of the chosen columns in each row."""
        indicator = np.zeros(len(self.costs), dtype=np.int64)
        indicator[chosen] = 1
        return np.asarray(self.matrix @ indicator, dtype=np.int64)

    def after(self, chosen: list[int], without: np.ndarray) -> "Cover":
        """The remaining cover when columns are chosen and others (a mask) are removed."""
        needs = self.needs - self.covered(chosen)
        gone = without.copy()
        gone[chosen] = True
        return open_cover(self.matrix, needs, self.costs, gone, self.budget)


def open_cover(
    matrix: csr_array, needs: Rows, costs: np.ndarray, gone: np.ndarray, budget: int | float = np.inf
) -> Cover:
    """Create the cover of the rows with positive needs, without the columns that are gone (a mask)."""
    open_rows = np.flatnonzero(needs > 0)
    part = csr_array(matrix[open_rows], dtype=np.int64)
    left = needs[open_rows]
    of_entry = np.repeat(np.arange(len(open_rows)), np.diff(part.indptr))
    part.data = np.where(gone[part.indices], 0, np.minimum(part.data, left[of_entry]))
    part.eliminate_zeros()
    part.sort_indices()
    return Cover(matrix=part, needs=left, costs=costs, budget=budget)


def cover_of(problem: DominationProblem) -> Cover:
    """State a problem as a cover."""
    matrix, needs = problem.requirements
    budget = np.inf if problem.budget is None else problem.budget
    return open_cover(matrix, needs, problem.costs, np.zeros(problem.num_nodes, dtype=bool), budget)


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
    """Split a cover without a budget into covers without common rows or columns, to solve separately."""
    return [
        Cover(matrix=csr_array(cover.matrix[rows]), needs=cover.needs[rows], costs=cover.costs)
        for rows in components(cover.matrix)
    ]


def dual_bound(cover: Cover) -> int | float:
    """A cost below which no choice of columns meets all rows: that of a packing of the rows.

    Any prices y >= 0 of the rows such that no column's rows are priced above its cost prove the bound
    sum(b y), by weak duality of linear programming. Each row's price starts at the least share of a column's
    cost among the column's entries, then rises as far as possible, rows with the lowest prices first.
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


_MOST_PRODUCTS = 20_000_000  # largest number of multiplications for comparing all pairs of rows or columns


@dataclass(frozen=True, kw_only=True, eq=False)
class Presolved:
    """A reduced cover, and columns that belong to a cheapest choice for the original cover."""

    cover: Cover
    """A cheapest choice for it, together with `chosen`, is a cheapest choice for the original cover."""

    chosen: list[int]
    """Columns without which no choice meets all rows, in the order found."""


def presolve(cover: Cover) -> Presolved:
    """Reduce a cover without a budget until nothing changes [1].

    - A column without which its row's need cannot be met is chosen.
    - A column is removed if another one, at no greater cost, alone meets all rows in which it has entries.
    - A row with need 1 is removed if it has all columns of another row: meeting that row meets it.

    Only the first rule is applied to covers with too many pairs of rows or columns to compare.

    References:
        [1] Weihe, Covering trains by stations or the power of data reduction, ALEX 1998.
    """
    chosen: list[int] = []
    while cover.matrix.nnz > 0:
        forced = _indispensable(cover)
        chosen += forced
        cover = cover.after(forced, np.zeros(len(cover.costs), dtype=bool))
        given_up = _beaten_columns(cover)
        cover = cover.after([], given_up)
        implied = _implied_rows(cover)
        needs = np.where(implied, 0, cover.needs)
        cover = open_cover(cover.matrix, needs, cover.costs, np.zeros(len(cover.costs), dtype=bool))
        if not forced and not given_up.any() and not implied.any():
            break
    return Presolved(cover=cover, chosen=chosen)


def _indispensable(cover: Cover) -> list[int]:
    sums = np.asarray(cover.matrix.sum(axis=1)).ravel()
    of_entry = np.repeat(np.arange(len(sums)), np.diff(cover.matrix.indptr))
    needed = (sums - cover.needs)[of_entry] < cover.matrix.data
    return np.unique(cover.matrix.indices[needed]).tolist()


def _beaten_columns(cover: Cover) -> np.ndarray:
    """A mask of the columns that another column replaces; the first of equal columns stays."""
    beaten = np.zeros(len(cover.costs), dtype=bool)
    of_entry = np.repeat(np.arange(len(cover.needs)), np.diff(cover.matrix.indptr))
    any_entry = _pattern(cover.matrix, np.ones(cover.matrix.nnz, dtype=bool))
    meets = _pattern(cover.matrix, cover.matrix.data >= cover.needs[of_entry])
    sizes = np.bincount(any_entry.indices, minlength=len(beaten))
    if float((np.diff(any_entry.indptr).astype(float) ** 2).sum()) > _MOST_PRODUCTS:
        return beaten
    common = csr_array(any_entry.T @ meets).tocoo()
    u, w = common.row, common.col
    replaces = (common.data == sizes[u]) & (u != w) & (cover.costs[w] <= cover.costs[u])
    pairs = np.stack([u[replaces], w[replaces]])
    keys = pairs[0].astype(np.int64) * len(beaten) + pairs[1]
    mutual = np.isin(pairs[1].astype(np.int64) * len(beaten) + pairs[0], keys)
    gone = ~mutual | (pairs[1] < pairs[0])
    beaten[pairs[0][gone]] = True
    return beaten


def _implied_rows(cover: Cover) -> np.ndarray:
    """A mask of the rows that another row implies; the first of equal rows stays."""
    implied = np.zeros(len(cover.needs), dtype=bool)
    pattern = _pattern(cover.matrix, np.ones(cover.matrix.nnz, dtype=bool))
    sizes = np.diff(pattern.indptr)
    in_columns = np.bincount(pattern.indices, minlength=len(cover.costs)).astype(float)
    if float((in_columns**2).sum()) > _MOST_PRODUCTS:
        return implied
    common = csr_array(pattern @ pattern.T).tocoo()
    smaller, larger = common.row, common.col
    implies = (common.data == sizes[smaller]) & (smaller != larger) & (cover.needs[larger] == 1)
    smaller, larger = smaller[implies], larger[implies]
    equal = (sizes[smaller] == sizes[larger]) & (cover.needs[smaller] == 1)
    implied[larger[~equal | (smaller < larger)]] = True
    return implied


def _pattern(matrix: csr_array, kept: np.ndarray) -> csr_array:
    pattern = csr_array((kept.astype(np.int64), matrix.indices, matrix.indptr), shape=matrix.shape, copy=True)
    pattern.eliminate_zeros()
    return pattern
