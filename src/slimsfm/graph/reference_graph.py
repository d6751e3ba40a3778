"""The reference graph: errors on ordered pairs of reference images."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceGraph:
    """How well each reference image localizes each other one.

    The errors are kept, not only the decisions, so a threshold can be chosen and changed afterwards.
    """

    names: tuple[str, ...]
    """The reference images, sorted."""

    errors: Float64[np.ndarray, "n n"]
    """[u, v] is the relative corner error of v's pose estimated from u alone; infinite without a pose."""

    def adjacency(self, threshold: float = 0.05) -> Bool[np.ndarray, "n n"]:
        """[u, v] is true where u localizes v: the error is below the threshold."""
        return self.errors < threshold

    def num_edges(self, threshold: float = 0.05) -> int:
        """Number of ordered pairs u, v, u not v, where u localizes v."""
        return int(self.adjacency(threshold).sum() - len(self.names))
