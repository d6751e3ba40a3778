"""Minimum dominating sets of directed graphs: pure graph theory, independent of images."""

from slimsfm.domination.exact_solvers import cpsat, exact
from slimsfm.domination.greedy_cover import cover_order, greedy, random_greedy
from slimsfm.domination.problem import Adjacency, DominationProblem, Solution, Solver, dominates

SOLVERS: dict[str, Solver] = {
    "cpsat": cpsat,
    "exact": exact,
    "greedy": greedy,
    "random": random_greedy,
}

__all__ = [
    "SOLVERS",
    "Adjacency",
    "DominationProblem",
    "Solution",
    "Solver",
    "cover_order",
    "cpsat",
    "dominates",
    "exact",
    "greedy",
    "random_greedy",
]
