"""The greedy solver and the order of all nodes, both built with the lazy greedy rule."""

from collections.abc import Iterable, Iterator
from heapq import heapify, heappop, heapreplace
from time import perf_counter

import numpy as np
from scipy.sparse import csr_array, vstack

from slimsfm.domination.cover import Columns, Cover, Rows, cover_of, dual_bound, presolve, split
from slimsfm.domination.local_search import improved, least_error_by_swaps
from slimsfm.domination.problem import DominationProblem
from slimsfm.domination.solution import Bounds, Solution, rounded_up, solution_of
from slimsfm.domination.validation import canonical_nodes


def lazy_greedy(
    cover: Cover, residual: Rows, candidates: Columns, *, budget: int | float = np.inf
) -> Iterator[int]:
    """Pick the column that adds the most for its cost, again and again, until none adds anything.

    The value that a column adds to a row is capped at what the row still lacks. It only shrinks with each
    pick, so a stale value is an upper bound, and only the head of a heap is evaluated again [1].

    Args:
        cover: The columns and their costs.
        residual: What each row lacks; updated with each pick.
        candidates: The columns to pick from.
        budget: The largest sum of costs; a column that no longer fits is skipped.

    Yields:
        Columns; the lowest index among equally good ones.

    References:
        [1] Minoux, Accelerated greedy algorithms for maximizing submodular set functions, 1978.
    """
    heap = _first_heap(cover, residual, candidates)
    left = budget * (1 + 1e-12)
    while heap:
        stale, column = heap[0]
        cost = float(cover.costs[column])
        if cost > left:
            heappop(heap)
            continue
        rows, values = cover.rows_of(column)
        added = np.minimum(values, residual[rows])
        value = -float(added.sum()) / cost
        if value > stale:
            heapreplace(heap, (value, column)) if value < 0 else heappop(heap)
            continue
        heappop(heap)
        residual[rows] -= added
        left -= cost
        yield column


def _first_heap(cover: Cover, residual: Rows, candidates: Columns) -> list[tuple[float, int]]:
    matrix = cover.matrix
    of_entry = np.repeat(np.arange(len(cover.needs)), np.diff(matrix.indptr))
    added = np.minimum(matrix.data, residual[of_entry])
    gains = np.bincount(matrix.indices, weights=added, minlength=len(cover.costs))
    useful = candidates[gains[candidates] > 0]
    heap = list(zip((-gains[useful] / cover.costs[useful]).tolist(), useful.tolist(), strict=True))
    heapify(heap)
    return heap


def without_redundant(cover: Cover, chosen: list[int]) -> list[int]:
    """Remove columns that no row needs, the most expensive first, then the last chosen."""
    covered = cover.covered(chosen)
    kept = set(chosen)
    order = sorted(range(len(chosen)), key=lambda i: (-cover.costs[chosen[i]], -i))
    for column in (chosen[i] for i in order):
        rows, values = cover.rows_of(column)
        spare = (covered[rows] - values >= cover.needs[rows]) | (covered[rows] < cover.needs[rows])
        if spare.all():
            covered[rows] -= values
            kept.remove(column)
    return [column for column in chosen if column in kept]


LARGE = 1000
"""Number of rows above which a cover is large: it is searched longer, and its relaxation is solved."""

_MOST_STEPS = 30_000  # for all pieces together
_STEPS_PER_ROW = 20
_ENTRIES = 40_000_000  # of the matrix, evaluated by all steps together


def greedy(problem: DominationProblem, *, seed: int = 0) -> Solution:
    """Find a small dominating set fast: greedily, then by local search.

    Without a budget the problem is reduced first, and its components are solved separately. The nodes that
    meet the most for their cost are chosen, with lazy evaluation, until all requirements are met or nothing
    more fits into the budget [1]; redundant nodes are removed; then weighted swaps search for a cheaper set,
    or under a budget for one that meets more. If the problem has errors, swaps of one node for another at no
    greater cost reduce them.

    Args:
        problem: What to meet.
        seed: Equal problems and seeds give equal solutions.

    Returns:
        A set that costs at most 1 + ln(d) times the least, where d is the most that one node contributes to
        the requirements: its out-degree and its groups plus k [1, 2]. Under a budget, with equal costs and
        k = 1, it meets at least 1 - 1/e of the most that can be met [3]. The lower bound on the cost is that
        of a packing of the nodes; under a budget there is no bound.

    Notes:
        The number of swaps is limited, not their time.

    References:
        [1] Chvátal, A greedy heuristic for the set-covering problem, 1979.
        [2] Dobson, Worst-case analysis of greedy heuristics for integer programming with nonnegative data,
            1982.
        [3] Nemhauser, Wolsey and Fisher, An analysis of approximations for maximizing submodular set
            functions, 1978.
    """
    start = perf_counter()
    cover = cover_of(problem)
    bound: int | float = 0
    if problem.budget is None:
        presolved = presolve(cover)
        pieces = split(presolved.cover)
        picked = list(presolved.chosen)
        bound = problem.cost(picked)
        for piece, part in zip(pieces, greedy_parts(pieces, seed=seed), strict=True):
            picked += part
            bound += part_bound(piece, whole=problem.whole_costs)
    else:
        picked = greedy_parts([cover], seed=seed)[0]
    chosen = tuple(sorted(picked))
    if problem.errors is not None:
        chosen = least_error_by_swaps(problem, chosen)
    return solution_of(problem, chosen, Bounds(cost=bound), start)


def greedy_parts(pieces: list[Cover], *, seed: int, effort: int = 1) -> list[list[int]]:
    """Choose columns of each cover greedily, remove redundant ones, and improve the choice by swaps.

    Covers of more than a thousand rows get `effort` times as many swaps.
    """
    shares = [_num_steps(piece) for piece in pieces]
    scale = min(1.0, _MOST_STEPS / max(sum(shares), 1))
    parts = []
    for piece, share in zip(pieces, shares, strict=True):
        times = effort if len(piece.needs) > LARGE else 1
        parts.append(_part(piece, int(scale * share * times), seed))
    return parts


def part_bound(piece: Cover, *, whole: bool) -> int | float:
    """A lower bound on the cost of a cover without a budget; an integer if all costs are integers."""
    bound = dual_bound(piece)
    return rounded_up(bound) if whole else bound


def _part(cover: Cover, steps: int, seed: int) -> list[int]:
    picks = list(lazy_greedy(cover, cover.needs.copy(), cover.candidates, budget=cover.budget))
    whole = bool(np.all(cover.costs == np.floor(cover.costs)))
    bound = part_bound(cover, whole=whole)
    return improved(cover, without_redundant(cover, picks), bound=bound, steps=steps, seed=seed)


def _num_steps(cover: Cover) -> int:
    """The number of swaps for which the search of a cover of this size ends in seconds."""
    rows, columns = len(cover.needs), len(cover.candidates)
    if rows == 0:
        return 0
    entries_a_step = 2 * (cover.matrix.nnz / columns) * (cover.matrix.nnz / rows)
    return int(min(_MOST_STEPS, 200 + _STEPS_PER_ROW * rows, _ENTRIES / entries_a_step))


def cover_order(problem: DominationProblem, *, first: Iterable[int] = ()) -> tuple[int, ...]:
    """Order all nodes such that every prefix is a good cover.

    The next node is the one that dominates, for its cost, the most nodes that are not dominated so far; a
    node dominates itself, and a group counts as a node that its members dominate. When all are dominated,
    nodes count that only one node dominates, then nodes that only two dominate, and so on. Ties are broken by
    index.

    Args:
        problem: The graph, costs and groups; its other parts are ignored.
        first: Nodes that come first, ordered by the same rule, such as a set chosen before.

    Returns:
        All nodes, each once. With equal costs and no `first`, the prefix of p nodes dominates at least
        1 - 1/e of what the best p nodes do [1], and the shortest prefix that dominates all has at most
        1 + ln(d) times as many nodes as the smallest dominating set, where d is the largest out-degree plus
        1 [2]. A group counts as a node throughout.

    Raises:
        ValueError: `first` has a node that is not in the graph.

    Notes:
        Lazy evaluation: nearly linear in the number of edges per number of dominators.

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
    return [set(first), everything - set(first)]


def _ordered(cover: Cover, before: list[int], stage: set[int]) -> list[int]:
    """The nodes of a stage in order, given the nodes before them."""
    order: list[int] = []
    level = 1
    while len(order) < len(stage):
        candidates = np.array(sorted(stage.difference(order)), dtype=np.int64)
        residual = np.minimum(cover.needs, level) - cover.covered(before + order)
        order += lazy_greedy(cover, np.maximum(residual, 0), candidates)
        level += 1
    return order
