"""Lazy greedy domination, the order of all nodes, and the random draws of the paper."""

from collections.abc import Iterable, Iterator
from heapq import heapify, heappop, heapreplace
from time import perf_counter

import numpy as np
from scipy.sparse import csr_array, vstack

from slimsfm.arrays import Ids
from slimsfm.domination.cover import Columns, Cover, Rows, cover_of, dual_bound, presolve, split
from slimsfm.domination.local_search import improved, least_error_by_swaps
from slimsfm.domination.problem import (
    Bounds,
    DominationProblem,
    Solution,
    canonical_nodes,
    merit,
    rounded_up,
    solution_of,
)


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


def random_greedy(problem: DominationProblem, *, draws: int = 1000, seed: int = 0) -> Solution:
    """Find a small dominating set by drawing many at random.

    Algorithm 2 of [1]: choose a random remaining node and remove it and its out-neighbors, until none
    remains. The best of all draws wins, the first found among equals.

    Beyond [1], a node remains until its requirement is met, and random members of a group are chosen until
    the group has one. Under a budget a node that no longer fits is skipped.

    Args:
        problem: The graph and its requirements.
        draws: Number of sets that are drawn; 1000 in [1].
        seed: Equal problems, draws and seeds give equal solutions.

    Returns:
        A dominating set. Its lower bound on the cost is that of a packing of the nodes; it is rarely tight,
        so optimality is rarely proven. Under a budget there is no bound.

    Raises:
        ValueError: `draws` is not positive.

    Notes:
        A draw takes time linear in nodes and edges. It never chooses a node that an earlier choice dominates,
        which a smallest set may need: there are graphs whose smallest sets no number of draws finds.

    References:
        [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set.
    """
    if draws < 1:
        raise ValueError(f"draws must be positive, got {draws}")
    start = perf_counter()
    rng = np.random.default_rng(seed)
    drawn = _Draws(problem)
    sets = (drawn.draw(rng) for _ in range(draws))
    if problem.budget is None and problem.errors is None:
        best = min(sets, key=lambda chosen: float(problem.costs[chosen].sum()))
    else:
        best = min(sets, key=lambda chosen: merit(problem, tuple(sorted(chosen))))
    bound = dual_bound(drawn.cover) if problem.budget is None else 0
    return solution_of(problem, tuple(sorted(best)), Bounds(cost=bound), start)


class _Draws:
    """A problem prepared for many draws."""

    def __init__(self, problem: DominationProblem) -> None:
        self.problem = problem
        self.cover = cover_of(problem)
        columns, matrix = self.cover.columns, self.cover.matrix
        self.rows = np.split(columns.indices, columns.indptr[1:-1])
        self.values = np.split(columns.data, columns.indptr[1:-1])
        self.members = np.split(matrix.indices, matrix.indptr[1:-1])
        self.own = _own_nodes(problem).tolist()

    def draw(self, rng: np.random.Generator) -> list[int]:
        """Visit the rows in random order: each is a uniform choice among the remaining ones."""
        residual = self.cover.needs.copy()
        chosen: list[int] = []
        left = self.cover.budget * (1 + 1e-12)
        for row in rng.permutation(len(residual)).tolist():
            if residual[row] <= 0:
                continue
            own = self.own[row]
            for node in [own] if own >= 0 else self._others(row, chosen, rng):
                if residual[row] > 0 and self.cover.costs[node] <= left:
                    chosen.append(node)
                    left -= self.cover.costs[node]
                    residual[self.rows[node]] -= self.values[node]
        return chosen

    def _others(self, row: int, chosen: list[int], rng: np.random.Generator) -> list[int]:
        """The members of a group that are not chosen, in random order."""
        members = np.setdiff1d(self.members[row], chosen)
        return rng.permutation(members).tolist()


def _own_nodes(problem: DominationProblem) -> Ids:
    """The node of each row of the problem's cover; -1 for groups."""
    _, needs = problem.requirements
    nodes = np.full(len(needs), -1, dtype=np.int64)
    nodes[: problem.num_nodes] = np.arange(problem.num_nodes)
    return nodes[needs > 0]
