"""What solvers return: a set, and how far it can be from the best."""

from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil, isfinite
from time import perf_counter
from typing import Protocol

from slimsfm.domination.problem import TOLERANCE, DominationProblem

_BOUND_TOLERANCE = 1e-6  # of the solvers' own arithmetic


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A dominating set and how far it can be from the best: fewest unmet, then cheapest, then least error."""

    chosen: tuple[int, ...]
    """The set's nodes, ascending."""

    cost: int | float
    """Sum of the nodes' costs: their number where the problem has no costs."""

    lower_bound: int | float
    """No set costs less that leaves no more unmet than the best one does; this is proven."""

    unmet: int = 0
    """How many nodes and groups lack what they ask for; 0 without a budget."""

    unmet_bound: int = 0
    """No set within the budget leaves fewer unmet; this is proven."""

    error: float = 0.0
    """Total error of the nodes that are not chosen; 0 where the problem has no errors."""

    error_bound: float = 0.0
    """No set that is best in cost has a smaller total error; this is proven."""

    seconds: float = field(default=0.0, compare=False)
    """How long the search took; takes no part in comparing solutions."""

    def __post_init__(self) -> None:
        if any(u >= v for u, v in pairwise(self.chosen)):
            raise ValueError(f"chosen must be ascending and distinct, got {self.chosen}")
        for value, bound in (("cost", "lower_bound"), ("unmet", "unmet_bound"), ("error", "error_bound")):
            most = getattr(self, value)
            if not 0 <= getattr(self, bound) <= most:
                raise ValueError(f"{bound} must be in [0, {most}], got {getattr(self, bound)}")

    @property
    def gap(self) -> int | float:
        """How much less the best set may cost, at most."""
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
    """What is proven of the best set of a problem."""

    unmet: int | float = 0
    """It leaves no fewer unmet."""

    cost: int | float = 0
    """It costs no less."""

    error: float = 0.0
    """Its total error is no smaller."""


class Solver(Protocol):
    """A method for the minimum dominating set: all take these arguments, their own ones have defaults."""

    def __call__(self, problem: DominationProblem, *, seed: int = 0) -> Solution:
        """Find a dominating set; `seed` settles what is left to chance."""
        ...


def merit(problem: DominationProblem, chosen: tuple[int, ...]) -> tuple[int, float, float]:
    """What solutions are compared by, the smaller the better: number unmet, cost, error.

    Cost and error are rounded, so that sums that differ only by the order of summation are equal.
    """
    cost, error = problem.cost(chosen), problem.total_error(chosen)
    return problem.num_unmet(chosen), _rounded(cost), _rounded(error)


def solution_of(
    problem: DominationProblem, chosen: tuple[int, ...], bounds: Bounds, start: float
) -> Solution:
    """Report a set with what is proven of the best one, found since `start` (of `perf_counter`).

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
    """The least whole number that is not below a bound, but for the arithmetic; minus infinity stays."""
    return ceil(bound - _BOUND_TOLERANCE) if isfinite(bound) else bound


def _met_bound(value: int | float, bound: int | float, *, whole: bool = False) -> int | float:
    """The bound, rounded up if whole, and equal to the value where it is so within the arithmetic."""
    if whole:
        return min(value, int(max(0, rounded_up(bound))))
    return value if bound >= value - _BOUND_TOLERANCE * max(1.0, value) else max(0.0, bound)


def _rounded(value: int | float) -> float:
    digits = -int(f"{TOLERANCE:e}".split("e")[1])
    return float(f"{value:.{digits}g}")
