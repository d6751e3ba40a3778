"""Data reduction: a smaller cover with the same least cost."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from slimsfm.domination.cover import Cover, made

_MOST_PRODUCTS = 20_000_000  # multiplications for which comparing all pairs of rows or columns is worth it


@dataclass(frozen=True, kw_only=True, eq=False)
class Kernel:
    """A reduced cover, and the columns that belong to a cheapest choice for the one it came from."""

    cover: Cover
    """A cheapest choice for it, with `chosen`, is a cheapest one for the cover that was reduced."""

    chosen: list[int]
    """Columns without which no choice meets all rows, in the order found."""


def reduced(cover: Cover) -> Kernel:
    """Reduce a cover without a budget until nothing changes [1].

    - A column without which its row's need cannot be met is chosen.
    - A column is given up if another one, at no greater cost, alone meets all rows that it has entries in.
    - A row that needs one is dropped if it has all columns of another row: who meets that meets it.

    A cover whose rows and columns have too many in common to compare is only searched for the first.

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
        cover = made(cover.matrix, needs, cover.costs, np.zeros(len(cover.costs), dtype=bool))
        if not forced and not given_up.any() and not implied.any():
            break
    return Kernel(cover=cover, chosen=chosen)


def _indispensable(cover: Cover) -> list[int]:
    sums = np.asarray(cover.matrix.sum(axis=1)).ravel()
    of_entry = np.repeat(np.arange(len(sums)), np.diff(cover.matrix.indptr))
    needed = (sums - cover.needs)[of_entry] < cover.matrix.data
    return np.unique(cover.matrix.indices[needed]).tolist()


def _beaten_columns(cover: Cover) -> np.ndarray:
    """A mask of the columns that another one replaces; of several equal ones the first stays."""
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
    """A mask of the rows that another one implies; of several equal ones the first stays."""
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
