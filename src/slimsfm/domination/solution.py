"""The result of a solver: a set, and proven bounds on the best set."""

from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil, isfinite
from time import perf_counter
from typing import Protocol

from slimsfm.domination.problem import TOLERANCE, DominationProblem

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
