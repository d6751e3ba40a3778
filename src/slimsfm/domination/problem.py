"""The minimum dominating set problem: its statement and its checkers."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array, diags_array, vstack

from slimsfm.arrays import Ids
from slimsfm.domination import validation
from slimsfm.domination.validation import Adjacency

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
        closed = validation.canonical_adjacency(adjacency)
        n = len(closed.indptr) - 1
        if dominators < 1:
            raise ValueError(f"dominators must be at least 1, got {dominators}")
        fields = {
            "adjacency": closed,
            "costs": validation.canonical_costs(costs, n),
            "dominators": dominators,
            "budget": budget,
            "groups": validation.canonical_groups(groups, n),
            "errors": None if errors is None else validation.canonical_errors(errors, closed),
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
        chosen = validation.canonical_nodes("chosen", chosen, self.num_nodes)
        if self.budget is None:
            return self.num_unmet(chosen) == 0
        return self.cost(chosen) <= self.budget * (1 + TOLERANCE)

    def _met(self, nodes: Ids) -> np.ndarray:
        matrix, needs = self.requirements
        indicator = np.zeros(self.num_nodes, dtype=np.int64)
        indicator[nodes] = 1
        return matrix @ indicator >= needs

    def _nodes(self, chosen: Iterable[int]) -> Ids:
        return np.array(validation.canonical_nodes("chosen", chosen, self.num_nodes), dtype=np.int64)


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
    nodes = list(validation.canonical_nodes("chosen", chosen, problem.num_nodes))
    dominated = np.zeros(problem.num_nodes, dtype=bool)
    dominated[problem.adjacency[nodes].indices] = True
    return bool(dominated.all())
