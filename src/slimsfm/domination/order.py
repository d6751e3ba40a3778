"""One order of all nodes in which every prefix covers well."""

from collections.abc import Iterable

import numpy as np
from scipy.sparse import csr_array, vstack

from slimsfm.domination.cover import Cover
from slimsfm.domination.lazy import lazy_greedy
from slimsfm.domination.problem import DominationProblem
from slimsfm.domination.validation import canonical_nodes


def cover_order(problem: DominationProblem, *, first: Iterable[int] = ()) -> tuple[int, ...]:
    """Order all nodes such that every prefix of the order is a good cover.

    The next node is the one that dominates, for its cost, the most nodes that are not dominated yet; a node
    dominates itself, and a group counts as a node that its members dominate. Once all are dominated, those
    count that only one node dominates, then those that only two do, and so on. Equally good nodes come by
    number.

    Args:
        problem: The graph, costs, groups and forced nodes; its other parts do not matter.
        first: Nodes that come first, ordered among themselves by the same rule: a set chosen before. After
            them come those forced in, then all that are not forced, then those forced out.

    Returns:
        All nodes, each once. With equal costs, nothing forced and no `first`, the prefix of p nodes dominates
        at least 1 - 1/e of what the best p nodes do [1], and the shortest prefix that dominates all has at
        most 1 + ln(d) times as many nodes as the smallest dominating set, d being the largest out-degree plus
        1 [2]. With a group, it counts as a node throughout.

    Raises:
        ValueError: `first` has a node that is not in the graph.

    Notes:
        Lazy evaluation: nearly linear in the number of edges for each number of dominators that is passed.

    References:
        [1] Nemhauser, Wolsey and Fisher, An analysis of approximations for maximizing submodular set
            functions, 1978.
        [2] Chvátal, A greedy heuristic for the set-covering problem, 1979.
    """
    matrix = csr_array(vstack([problem.adjacency.T, problem.groups], format="csr"), dtype=np.int64)
    matrix.sort_indices()
    sizes = np.diff(matrix.indptr).astype(np.int64)
    cover = Cover(matrix=matrix, needs=sizes, costs=problem.costs)
    order: list[int] = []
    for stage in _stages(problem, canonical_nodes("first", first, problem.num_nodes)):
        order += _ordered(cover, order, stage)
    return tuple(order)


def _stages(problem: DominationProblem, first: tuple[int, ...]) -> list[set[int]]:
    everything = set(range(problem.num_nodes))
    stages = [set(first), set(problem.forced_in), everything - set(problem.forced_out), everything]
    return [stage - set().union(*stages[:number]) for number, stage in enumerate(stages)]


def _ordered(cover: Cover, before: list[int], stage: set[int]) -> list[int]:
    """The nodes of a stage in their order, after others that come before."""
    order: list[int] = []
    level = 1
    while len(order) < len(stage):
        candidates = np.array(sorted(stage.difference(order)), dtype=np.int64)
        residual = np.minimum(cover.needs, level) - cover.covered(before + order)
        order += lazy_greedy(cover, np.maximum(residual, 0), candidates)
        level += 1
    return order
