"""The greedy rule with lazy evaluation, which covers and orders are built with."""

from collections.abc import Iterator
from heapq import heapify, heappop, heapreplace

import numpy as np

from slimsfm.domination.cover import Columns, Cover, Rows


def lazy_greedy(
    cover: Cover, residual: Rows, candidates: Columns, *, budget: int | float = np.inf
) -> Iterator[int]:
    """Pick the column that adds the most for its cost, again and again, until none adds anything.

    What a column adds to a row is capped at what the row still lacks. That only shrinks with each pick, so a
    stale value is an upper bound, and only the head of a heap is evaluated again [1].

    Args:
        cover: The columns and their costs.
        residual: What each row lacks; changed with each pick.
        candidates: The columns to pick from.
        budget: The largest sum of costs; a column that no longer fits is passed over.

    Yields:
        Columns; of equally good ones the one with the smallest number.

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
    """Leave out columns without which no row that is met would not be: the dearest first, then the last."""
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
