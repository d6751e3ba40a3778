"""The minimum dominating set problem: its statement, the checks of its input, and solutions."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import ceil, isfinite
from time import perf_counter
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array, sparray, vstack

from slimsfm.arrays import Ids

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


TOLERANCE = 1e-9
"""Sums of costs or errors are equal if they differ by less than this share."""


@dataclass(frozen=True, eq=False, init=False)
class DominationProblem:
    """Find the cheapest nodes of a directed graph that dominate all other nodes.

    A set D of nodes meets the requirement of node v if v is in D, or if at least k nodes of D have an edge to
    v, where k is `dominators`: k-domination [1], which for k = 1 is that of [2]. If fewer than k nodes have
    an edge to v, all of them are enough; if none has, v itself must be in D. The requirement of a group is
    met if one of its nodes is in D.

    Without a budget, all requirements must be met at the least cost. With a budget, the sum of the costs
    stays within it, and D meets as many requirements as possible, of nodes and groups alike; among sets that
    meet equally many, a cheapest one is best. With `errors`, a set of least total error is best among these.

    Raises:
        ValueError: `adjacency` is not square, not numeric or not finite; `costs` are not one positive finite
            number per node; `dominators` is below 1; `budget` is negative; a group has no node; or an edge
            has no error, or one that is negative or not finite.

    References:
        [1] Fink and Jacobson, n-domination in graphs, Graph Theory with Applications to Algorithms and
            Computer Science, 1985.
        [2] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set.
    """

    adjacency: csr_array
    """Boolean matrix in canonical CSR form: entry [u, v] is true when u dominates v. The diagonal is always
    true, because every node dominates itself."""

    costs: np.ndarray
    """Cost of each node; 1 by default."""

    dominators: int
    """Number of chosen nodes that dominate each node that is not chosen, where enough nodes can."""

    budget: int | float | None
    """Largest sum of costs, or None."""

    groups: csr_array
    """Boolean matrix; at least one node of each row must be chosen."""

    errors: csr_array | None
    """Error of v when u dominates it, on the entries of `adjacency`, 0 on the diagonal; or None."""

    def __init__(
        self,
        adjacency: Adjacency,
        *,
        costs: np.ndarray | None = None,
        dominators: int = 1,
        budget: int | float | None = None,
        groups: Adjacency | None = None,
        errors: Adjacency | None = None,
    ) -> None:
        closed = canonical_adjacency(adjacency)
        n = len(closed.indptr) - 1
        if dominators < 1:
            raise ValueError(f"dominators must be at least 1, got {dominators}")
        fields = {
            "adjacency": closed,
            "costs": canonical_costs(costs, n),
            "dominators": dominators,
            "budget": budget,
            "groups": canonical_groups(groups, n),
            "errors": None if errors is None else canonical_errors(errors, closed),
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        if budget is not None and not budget >= 0:
            raise ValueError(f"budget must not be negative, got {budget}")

    @property
    def num_nodes(self) -> int:
        """Number of nodes of the graph."""
        return len(self.adjacency.indptr) - 1

    @property
    def whole_costs(self) -> bool:
        """Whether all costs are integers, as they are by default."""
        return bool(np.all(self.costs == np.floor(self.costs)))

    @cached_property
    def requirements(self) -> tuple[csr_array, Ids]:
        """The requirements as a covering problem: an integer matrix A and a vector b.

        The set with indicator x meets requirement i if (A x)_i >= b_i. The requirements of the nodes come
        first, those of the groups last.
        """
        identity = diags_array(np.ones(self.num_nodes), format="csr", dtype=np.int64)
        others = csr_array((self.adjacency.astype(np.int64) - identity).T)
        available = np.asarray(others.sum(axis=1), dtype=np.int64).ravel()
        needs = np.maximum(np.minimum(self.dominators, available), 1)
        own = diags_array(needs, format="csr", dtype=np.int64)
        grouped = csr_array(self.groups.astype(np.int64))
        matrix = csr_array(vstack([others + own, grouped], format="csr"))
        matrix.eliminate_zeros()
        matrix.sort_indices()
        return matrix, np.concatenate([needs, np.ones(len(grouped.indptr) - 1, dtype=np.int64)])

    def cost(self, chosen: Iterable[int]) -> int | float:
        """Sum of the costs of nodes; an int if all costs are integers."""
        total = float(self.costs[self._nodes(chosen)].sum())
        return int(total) if self.whole_costs else total

    def num_unmet(self, chosen: Iterable[int]) -> int:
        """Number of requirements of nodes and groups that a set does not meet.

        Raises:
            ValueError: `chosen` has a node that is not in the graph.
        """
        return int((~self._met(self._nodes(chosen))).sum())

    def total_error(self, chosen: Iterable[int]) -> float:
        """Sum of the errors of the nodes that are not chosen and whose requirements are met.

        Each node counts with its least error from a chosen node. The sum is 0 if the problem has no errors.

        Raises:
            ValueError: `chosen` has a node that is not in the graph.
        """
        nodes = self._nodes(chosen)
        if self.errors is None:
            return 0.0
        best = np.full(self.num_nodes, np.inf)
        reached = self.errors[nodes]
        np.minimum.at(best, reached.indices, reached.data)
        counted = self._met(nodes)[: self.num_nodes] & np.isfinite(best)
        return float(best[counted].sum())

    def satisfies(self, chosen: Iterable[int]) -> bool:
        """Check whether a set is feasible: without a budget it meets all requirements, else it is within it.

        Feasible sets are compared by `num_unmet`, `cost` and `total_error`, in this order.

        Raises:
            ValueError: `chosen` has a node that is not in the graph.
        """
        chosen = canonical_nodes("chosen", chosen, self.num_nodes)
        if self.budget is None:
            return self.num_unmet(chosen) == 0
        return self.cost(chosen) <= self.budget * (1 + TOLERANCE)

    def _met(self, nodes: Ids) -> np.ndarray:
        matrix, needs = self.requirements
        indicator = np.zeros(self.num_nodes, dtype=np.int64)
        indicator[nodes] = 1
        return matrix @ indicator >= needs

    def _nodes(self, chosen: Iterable[int]) -> Ids:
        return np.array(canonical_nodes("chosen", chosen, self.num_nodes), dtype=np.int64)


def dominates(adjacency: Adjacency, chosen: Iterable[int]) -> bool:
    """Check whether nodes dominate a directed graph.

    A set D dominates a graph if every node is in D or has an edge from a node in D [1].

    Args:
        adjacency: Square matrix, entry [u, v] true when u dominates v. Its diagonal counts as true.
        chosen: The nodes of D, in any order. The empty set dominates only the empty graph.

    Returns:
        True if every node is dominated.

    Raises:
        ValueError: `adjacency` is not valid for a problem, or `chosen` has a node that is not in the graph.

    Notes:
        Time is linear in the number of edges.

    References:
        [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set.
    """
    problem = DominationProblem(adjacency)
    nodes = list(canonical_nodes("chosen", chosen, problem.num_nodes))
    dominated = np.zeros(problem.num_nodes, dtype=bool)
    dominated[problem.adjacency[nodes].indices] = True
    return bool(dominated.all())


_BOUND_TOLERANCE = 1e-6  # rounding errors of the solvers


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A dominating set and bounds on the best one: fewest unmet, then cheapest, then least error."""

    chosen: tuple[int, ...]
    """The set's nodes, ascending."""

    cost: int | float
    """Sum of the nodes' costs; by default their number."""

    lower_bound: int | float
    """Proven: no set that leaves as few requirements unmet as the best one costs less."""

    unmet: int = 0
    """Number of requirements that are not met; 0 without a budget."""

    unmet_bound: int = 0
    """Proven: no set within the budget leaves fewer requirements unmet."""

    error: float = 0.0
    """Total error of the nodes that are not chosen; 0 if the problem has no errors."""

    error_bound: float = 0.0
    """Proven: no set of the least cost has a smaller total error."""

    seconds: float = field(default=0.0, compare=False)
    """Duration of the search; ignored when solutions are compared."""

    def __post_init__(self) -> None:
        if any(u >= v for u, v in pairwise(self.chosen)):
            raise ValueError(f"chosen must be ascending and distinct, got {self.chosen}")
        for value, bound in (("cost", "lower_bound"), ("unmet", "unmet_bound"), ("error", "error_bound")):
            most = getattr(self, value)
            if not 0 <= getattr(self, bound) <= most:
                raise ValueError(f"{bound} must be in [0, {most}], got {getattr(self, bound)}")

    @property
    def gap(self) -> int | float:
        """Upper bound of the cost that a better set could save."""
        return self.cost - self.lower_bound

    @property
    def is_cheapest(self) -> bool:
        """Whether it is proven that no set that leaves as few unmet costs less."""
        return self.unmet == self.unmet_bound and self.gap == 0

    @property
    def is_optimal(self) -> bool:
        """Whether it is proven that no set is better, in number of unmet, then cost, then error."""
        return self.is_cheapest and self.error == self.error_bound


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Proven bounds on the best set of a problem."""

    unmet: int | float = 0
    """Least number of unmet requirements."""

    cost: int | float = 0
    """Least cost."""

    error: float = 0.0
    """Least total error."""


class Solver(Protocol):
    """A solver of the minimum dominating set problem; further arguments have defaults."""

    def __call__(self, problem: DominationProblem, *, seed: int = 0) -> Solution:
        """Find a dominating set; equal problems and seeds give equal solutions."""
        ...


def merit(problem: DominationProblem, chosen: tuple[int, ...]) -> tuple[int, float, float]:
    """The key by which solutions are compared, smaller is better: number unmet, cost, error.

    Cost and error are rounded, so that sums that differ only in the order of summation are equal.
    """
    cost, error = problem.cost(chosen), problem.total_error(chosen)
    return problem.num_unmet(chosen), _rounded(cost), _rounded(error)


def solution_of(
    problem: DominationProblem, chosen: tuple[int, ...], bounds: Bounds, start: float
) -> Solution:
    """Create the solution of a search that started at `start`, by `perf_counter`.

    A bound on the cost counts only once it is proven that no set leaves fewer unmet, one on the error once
    the cost is proven least. Where costs are whole numbers, so is the bound on them.
    """
    cost, unmet, error = problem.cost(chosen), problem.num_unmet(chosen), problem.total_error(chosen)
    best_unmet = int(min(bounds.unmet, unmet))
    lower = _met_bound(cost, bounds.cost, whole=problem.whole_costs) if best_unmet == unmet else 0
    proven = best_unmet == unmet and lower == cost
    return Solution(
        chosen=chosen,
        cost=cost,
        lower_bound=lower,
        unmet=unmet,
        unmet_bound=best_unmet,
        error=error,
        error_bound=_met_bound(error, bounds.error) if proven else 0.0,
        seconds=perf_counter() - start,
    )


def rounded_up(bound: int | float) -> int | float:
    """The least integer that is not below a bound, up to rounding errors; minus infinity is unchanged."""
    return ceil(bound - _BOUND_TOLERANCE) if isfinite(bound) else bound


def _met_bound(value: int | float, bound: int | float, *, whole: bool = False) -> int | float:
    """The bound, rounded up if whole, and equal to the value if they agree up to rounding errors."""
    if whole:
        return min(value, int(max(0, rounded_up(bound))))
    return value if bound >= value - _BOUND_TOLERANCE * max(1.0, value) else max(0.0, bound)


def _rounded(value: int | float) -> float:
    digits = -int(f"{TOLERANCE:e}".split("e")[1])
    return float(f"{value:.{digits}g}")
