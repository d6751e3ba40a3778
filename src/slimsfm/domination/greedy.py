"""The greedy solver: most coverage for its cost, then swaps."""

from time import perf_counter

import numpy as np

from slimsfm.domination.cover import Cover, cover_of, dual_bound, split
from slimsfm.domination.lazy import lazy_greedy, without_redundant
from slimsfm.domination.local_search import improved
from slimsfm.domination.presolve import reduced
from slimsfm.domination.problem import DominationProblem
from slimsfm.domination.solution import Bounds, Solution, rounded_up, solution_of
from slimsfm.domination.swaps import least_error_by_swaps

LARGE = 1000
"""A cover of more rows is large: worth another search than small ones, which are soon solved."""

_MOST_STEPS = 30_000  # of all pieces together
_STEPS_PER_ROW = 20
_ENTRIES = 40_000_000  # of the matrix, to be looked at by all steps together


def greedy(problem: DominationProblem, *, seed: int = 0) -> Solution:
    """Find a small dominating set fast: greedily, then by local search.

    Without a budget the problem is reduced first, and its components are solved apart. Nodes that meet the
    most for their cost are chosen until all is met or nothing more fits into the budget [1], with lazy
    evaluation; those that turn out redundant are left out; then weighted swaps look for a cheaper set, or
    under a budget for one that meets more. If the problem has errors, swaps of one node for another at no
    greater cost reduce them.

    Args:
        problem: What to meet.
        seed: Equal problems and seeds give equal solutions.

    Returns:
        A set that costs at most 1 + ln(d) times the least, d being the most that one node adds to what is
        asked for: its out-degree and its groups plus k [1, 2]. Under a budget, with equal costs and k = 1,
        the nodes not forced in meet at least 1 - 1/e of the most that can be met beyond those [3]. The lower
        bound on the cost is that of a packing of the nodes; under a budget it is that of the nodes forced
        in, and what must stay unmet and the errors have none.

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
    picked, bound = list(problem.forced_in), problem.cost(problem.forced_in)
    if problem.budget is None:
        kernel = reduced(cover)
        pieces = split(kernel.cover)
        picked += kernel.chosen
        bound = problem.cost(picked)
        for piece, part in zip(pieces, greedy_parts(pieces, seed=seed), strict=True):
            picked += part
            bound += part_bound(piece, whole=problem.whole_costs)
    else:
        picked += greedy_parts([cover], seed=seed)[0]
    chosen = tuple(sorted(picked))
    if problem.errors is not None:
        chosen = least_error_by_swaps(problem, chosen)
    return solution_of(problem, chosen, Bounds(cost=bound), start)


def greedy_parts(pieces: list[Cover], *, seed: int, effort: int = 1) -> list[list[int]]:
    """Choose columns of each cover greedily, leave out redundant ones, and swap while that helps.

    Covers of more than a thousand rows get `effort` times the swaps.
    """
    shares = [_num_steps(piece) for piece in pieces]
    scale = min(1.0, _MOST_STEPS / max(sum(shares), 1))
    parts = []
    for piece, share in zip(pieces, shares, strict=True):
        times = effort if len(piece.needs) > LARGE else 1
        parts.append(_part(piece, int(scale * share * times), seed))
    return parts


def part_bound(piece: Cover, *, whole: bool) -> int | float:
    """A bound on the cost of a cover without a budget; a whole number if all costs are."""
    bound = dual_bound(piece)
    return rounded_up(bound) if whole else bound


def _part(cover: Cover, steps: int, seed: int) -> list[int]:
    picks = list(lazy_greedy(cover, cover.needs.copy(), cover.candidates, budget=cover.budget))
    whole = bool(np.all(cover.costs == np.floor(cover.costs)))
    bound = part_bound(cover, whole=whole)
    return improved(cover, without_redundant(cover, picks), bound=bound, steps=steps, seed=seed)


def _num_steps(cover: Cover) -> int:
    """As many as the size of the cover allows, so that the search ends in seconds."""
    rows, columns = len(cover.needs), len(cover.candidates)
    if rows == 0:
        return 0
    entries_a_step = 2 * (cover.matrix.nnz / columns) * (cover.matrix.nnz / rows)
    return int(min(_MOST_STEPS, 200 + _STEPS_PER_ROW * rows, _ENTRIES / entries_a_step))
