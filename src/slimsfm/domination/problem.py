"""The minimum dominating set problem: its statement, its solutions and their checker."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array, eye_array

Adjacency = csr_array | np.ndarray
"""Square matrix, row u the nodes that u dominates; what is not zero counts as true."""


@dataclass(frozen=True, eq=False, init=False)
class DominationProblem:
    """A directed graph, of which the fewest nodes that dominate all others are sought.

    Raises:
        ValueError: `adjacency` is not square, not numeric or not finite.
    """

    adjacency: csr_array
    """Boolean matrix in canonical CSR form: entry [u, v] is true when u dominates v. Whatever was given, its
    diagonal is true, since every node dominates itself."""

    def __init__(self, adjacency: Adjacency) -> None:
        object.__setattr__(self, "adjacency", _canonical(adjacency))

    @property
    def num_nodes(self) -> int:
        """Number of nodes of the graph."""
        return len(self.adjacency.indptr) - 1

    @property
    def degree_bound(self) -> int:
        """Number of nodes over the most that one dominates, rounded up: no dominating set has fewer."""
        if self.num_nodes == 0:
            return 0
        return -(-self.num_nodes // int(np.diff(self.adjacency.indptr).max()))


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A dominating set and how far it can be from the smallest."""

    chosen: tuple[int, ...]
    """The set's nodes, ascending."""

    lower_bound: int
    """No dominating set of the graph has fewer nodes; this is proven."""

    def __post_init__(self) -> None:
        if any(u >= v for u, v in pairwise(self.chosen)):
            raise ValueError(f"chosen must be ascending and distinct, got {self.chosen}")
        if not 0 <= self.lower_bound <= len(self.chosen):
            raise ValueError(f"lower_bound must be in [0, {len(self.chosen)}], got {self.lower_bound}")

    @property
    def gap(self) -> int:
        """How many nodes the smallest dominating set may have less, at most."""
        return len(self.chosen) - self.lower_bound

    @property
    def is_optimal(self) -> bool:
        """Whether the set is proven to be of the smallest size."""
        return self.gap == 0


class Solver(Protocol):
    """A method for the minimum dominating set: all take these arguments, their own ones have defaults."""

    def __call__(self, problem: DominationProblem, *, seed: int = 0) -> Solution:
        """Find a dominating set; `seed` settles what is left to chance."""
        ...


def dominates(adjacency: Adjacency, chosen: Iterable[int]) -> bool:
    """Check whether nodes dominate a directed graph.

    A set D dominates a graph if every node is in D or has an edge from a node in D [1].

    Args:
        adjacency: Square matrix, entry [u, v] true when u dominates v. Its diagonal counts as true.
        chosen: The nodes of D, in any order; the empty set dominates the empty graph alone.

    Returns:
        True if no node is left undominated.

    Raises:
        ValueError: `adjacency` is no problem's, or `chosen` has a node that is not in the graph.

    Notes:
        Time is linear in the number of edges.

    References:
        [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set.
    """
    problem = DominationProblem(adjacency)
    nodes = np.array(list(chosen), dtype=np.int64)
    if np.any((nodes < 0) | (nodes >= problem.num_nodes)):
        raise ValueError(f"chosen must be nodes in [0, {problem.num_nodes}), got {nodes.tolist()}")
    dominated = np.zeros(problem.num_nodes, dtype=bool)
    dominated[problem.adjacency[nodes].indices] = True
    return bool(dominated.all())


def _canonical(adjacency: Adjacency) -> csr_array:
    shape = tuple(adjacency.shape or ())
    if len(shape) != 2 or shape[0] != shape[1]:
        raise ValueError(f"adjacency must be a square matrix, got shape {shape}")
    if adjacency.dtype.kind not in "biuf":
        raise ValueError(f"adjacency must be boolean or real, got {adjacency.dtype}")
    values = csr_array(adjacency)
    if not np.all(np.isfinite(values.data)):
        raise ValueError("adjacency must be finite, got NaN or infinity")
    closed = csr_array(values.astype(bool) + eye_array(shape[0], dtype=bool, format="csr"))
    closed.sum_duplicates()
    closed.eliminate_zeros()
    return closed
