"""Checks of the parts of a problem, and their canonical forms."""

from collections.abc import Iterable

import numpy as np
from scipy.sparse import csr_array, eye_array, sparray

Adjacency = csr_array | np.ndarray
"""Square matrix; row u marks the nodes that u dominates. Values other than zero count as true."""


def canonical_adjacency(adjacency: Adjacency) -> csr_array:
    """A boolean matrix in canonical CSR form whose diagonal is true."""
    shape = tuple(adjacency.shape or ())
    if len(shape) != 2 or shape[0] != shape[1]:
        raise ValueError(f"adjacency must be a square matrix, got shape {shape}")
    values = _numbers("adjacency", adjacency)
    closed = csr_array(values.astype(bool) + eye_array(shape[0], dtype=bool, format="csr"))
    closed.sum_duplicates()
    closed.eliminate_zeros()
    return closed


def canonical_costs(costs: np.ndarray | None, num_nodes: int) -> np.ndarray:
    """One positive number per node; 1 by default."""
    if costs is None:
        return np.ones(num_nodes)
    values = np.array(costs, dtype=np.float64)
    if values.shape != (num_nodes,):
        raise ValueError(f"costs must be one per node, of shape ({num_nodes},), got shape {values.shape}")
    wrong = ~(np.isfinite(values) & (values > 0))
    if wrong.any():
        raise ValueError(f"costs must be positive and finite, got {values[wrong][0]}")
    return values


def canonical_nodes(name: str, nodes: Iterable[int], num_nodes: int) -> tuple[int, ...]:
    """The nodes in ascending order, without duplicates."""
    ids = np.array(list(nodes), dtype=np.int64)
    if np.any((ids < 0) | (ids >= num_nodes)):
        raise ValueError(f"{name} must be nodes in [0, {num_nodes}), got {ids.tolist()}")
    return tuple(np.unique(ids).tolist())


def canonical_groups(groups: Adjacency | None, num_nodes: int) -> csr_array:
    """A boolean matrix in canonical CSR form, one column per node; without rows if there are no groups."""
    if groups is None:
        return csr_array((0, num_nodes), dtype=bool)
    shape = tuple(groups.shape or ())
    if len(shape) != 2 or shape[1] != num_nodes:
        raise ValueError(f"groups must be a matrix of {num_nodes} columns, got shape {shape}")
    rows = csr_array(_numbers("groups", groups).astype(bool))
    rows.sum_duplicates()
    rows.eliminate_zeros()
    empty = np.flatnonzero(np.diff(rows.indptr) == 0)
    if len(empty):
        raise ValueError(f"groups must each have a node, got none in {empty.tolist()}")
    return rows


def canonical_errors(errors: Adjacency, adjacency: csr_array) -> csr_array:
    """The errors on exactly the entries of the adjacency; 0 on the diagonal."""
    if tuple(errors.shape or ()) != adjacency.shape:
        raise ValueError(f"errors must be of shape {adjacency.shape}, got {tuple(errors.shape or ())}")
    rows = np.repeat(np.arange(len(adjacency.indptr) - 1), np.diff(adjacency.indptr))
    columns = adjacency.indices
    data = _looked_up(errors, rows, columns)
    data[rows == columns] = 0.0
    wrong = ~(np.isfinite(data) & (data >= 0))
    if wrong.any():
        u, v, value = rows[wrong][0], columns[wrong][0], data[wrong][0]
        given = "none" if np.isnan(value) else f"{value}"
        raise ValueError(f"errors must be finite and 0 or more on every edge, got {given} on ({u}, {v})")
    return csr_array((data, columns.copy(), adjacency.indptr.copy()), shape=adjacency.shape)


def _looked_up(errors: Adjacency, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The values at entries; NaN where a sparse matrix stores no value."""
    if not isinstance(errors, sparray):
        return np.asarray(errors, dtype=np.float64)[rows, columns]
    stored = csr_array(errors, dtype=np.float64, copy=True)
    stored.sum_duplicates()
    n = len(stored.indptr) - 1
    keys = np.repeat(np.arange(n), np.diff(stored.indptr)) * n + stored.indices
    wanted = rows * n + columns
    place = np.searchsorted(keys, wanted)
    found = place < len(keys)
    found[found] = keys[place[found]] == wanted[found]
    values = np.full(len(wanted), np.nan)
    values[found] = stored.data[place[found]]
    return values


def _numbers(name: str, matrix: Adjacency) -> csr_array:
    if matrix.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be boolean or real, got {matrix.dtype}")
    values = csr_array(matrix)
    if not np.all(np.isfinite(values.data)):
        raise ValueError(f"{name} must be finite, got NaN or infinity")
    return values
