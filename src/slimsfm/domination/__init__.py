"""Minimum dominating sets of directed graphs: pure graph theory, which knows of no images."""

from slimsfm.domination.exact import exact
from slimsfm.domination.problem import Adjacency, DominationProblem, Solution, Solver, dominates
from slimsfm.domination.random_greedy import random_greedy

SOLVERS: dict[str, Solver] = {
    "exact": exact,
    "random": random_greedy,
}

__all__ = [
    "SOLVERS",
    "Adjacency",
    "DominationProblem",
    "Solution",
    "Solver",
    "dominates",
    "exact",
    "random_greedy",
]
