"""Integer programs, to be minimized by any solver of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_array, csr_array, vstack

from slimsfm.domination.cover import Cover
from slimsfm.domination.problem import TOLERANCE


@dataclass(frozen=True, kw_only=True, eq=False)
class Program:
    """Minimize c x over 0-1 vectors x between two others, with A x >= b."""

    objective: np.ndarray
    """c."""

    matrix: csr_array
    """A."""

    lower: np.ndarray
    """b."""

    least: np.ndarray
    """Least value of each variable, 0 or 1."""

    most: np.ndarray
    """Largest value of each variable, 0 or 1."""

    def aiming_at(self, objective: np.ndarray) -> "Program":
        """The program with another objective."""
        return replace(self, objective=objective)

    def holding(self, value: int | float) -> "Program":
        """The program with its objective held at a value or below."""
        limit = value + TOLERANCE * max(1.0, abs(value))
        row = csr_array(-self.objective[None])
        return replace(
            self,
            matrix=csr_array(vstack([self.matrix, row], format="csr")),
            lower=np.append(self.lower, -limit),
        )

    def extended(self, old: csr_array, new: csr_array, lower: np.ndarray, costs: np.ndarray) -> "Program":
        """The program with more variables, of given costs, and the constraints old x + new y >= lower."""
        count = len(costs)
        return Program(
            objective=np.concatenate([self.objective, costs]),
            matrix=csr_array(block_array([[self.matrix, None], [old, new]], format="csr")),
            lower=np.concatenate([self.lower, lower]),
            least=np.concatenate([self.least, np.zeros(count)]),
            most=np.concatenate([self.most, np.ones(count)]),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Minimum:
    """What a search for a program's minimum ended with."""

    values: np.ndarray | None
    """The best variables found, or None."""

    bound: int | float
    """No feasible vector has a smaller objective."""


Minimizer = Callable[[Program, np.ndarray, float], Minimum]
"""Minimizes a program, given what is known of a good vector's first variables, in so many seconds at most."""


def covering_program(cover: Cover) -> Program:
    """The cheapest choice for a cover without a budget; one variable for each of its candidates."""
    columns = cover.candidates
    return Program(
        objective=cover.costs[columns],
        matrix=csr_array(cover.matrix[:, columns], dtype=np.float64),
        lower=cover.needs.astype(np.float64),
        least=np.zeros(len(columns)),
        most=np.ones(len(columns)),
    )
