"""The reference graph: errors on ordered pairs of reference images."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceGraph:
    """How well each reference image localizes each other reference image.

    The graph holds errors, not decisions, so that the threshold can be changed later.
    """

    names: tuple[str, ...]
    """The reference images, sorted."""

    errors: csr_array
    """n x n; the entry [u, v] is the relative corner error of v's pose estimated from u alone. Pairs
    without a pose and the diagonal have no entry."""

    @classmethod
    def from_errors(
        cls, names: tuple[str, ...], pairs: Int64[np.ndarray, "k 2"], errors: Float64[np.ndarray, " k"]
    ) -> "ReferenceGraph":
        """Create the graph with error `errors[i]` on the ordered pair `pairs[i]`.

        Raises:
            ValueError: A pair joins an image with itself, occurs twice or has an index out of range, or an
                error is negative or NaN.
        """
        _check(len(names), pairs, errors)
        finite = np.isfinite(errors)
        rows, columns = pairs[finite].T
        shape = (len(names), len(names))
        stored = csr_array(coo_array((errors[finite], (rows, columns)), shape=shape))
        stored.sort_indices()
        return cls(names=names, errors=stored)

    def dense(self) -> Float64[np.ndarray, "n n"]:
        """The errors as a dense matrix: 0 on the diagonal, infinite where there is no pose."""
        full = np.full((len(self.names), len(self.names)), np.inf)
        entries = self.errors.tocoo()
        full[entries.row, entries.col] = entries.data
        np.fill_diagonal(full, 0)
        return full

    def adjacency(self, threshold: float = 0.05) -> csr_array:
        """[u, v] is true where u localizes v: the error is below the threshold. The diagonal is false."""
        entries = self.errors.tocoo()
        good = entries.data < threshold
        values = np.ones(int(good.sum()), bool)
        return csr_array((values, (entries.row[good], entries.col[good])), shape=self.errors.shape)

    def num_edges(self, threshold: float = 0.05) -> int:
        """Number of ordered pairs u, v where u localizes v."""
        return int((self.errors.data < threshold).sum())

    def degrees(self, threshold: float = 0.05) -> Int64[np.ndarray, "2 n"]:
        """Out-degrees and in-degrees: how many others an image localizes, and how many localize it."""
        edges = self.adjacency(threshold).astype(np.int64)
        return np.stack([np.asarray(edges.sum(axis=axis)).ravel() for axis in (1, 0)]).astype(np.int64)

    def isolated(self, threshold: float = 0.05) -> Bool[np.ndarray, " n"]:
        """Which images neither localize another image nor are localized by one."""
        return self.degrees(threshold).sum(axis=0) == 0

    def num_components(self, threshold: float = 0.05) -> int:
        """Number of weakly connected components."""
        return int(connected_components(self.adjacency(threshold), directed=False, return_labels=False))


@dataclass(frozen=True, kw_only=True, eq=False)
class GraphRun:
    """A reference graph and the effort of computing it."""

    graph: ReferenceGraph
    """The reference graph."""

    pairs_tried: int
    """Number of unordered pairs of images that were localized from each other, in both directions."""

    seconds: dict[str, float]
    """Seconds of each stage."""


def _check(count: int, pairs: np.ndarray, errors: np.ndarray) -> None:
    if len(pairs) != len(errors):
        raise ValueError(f"pairs and errors must be of equal length, got {len(pairs)} and {len(errors)}")
    if np.isnan(errors).any() or (errors < 0).any():
        raise ValueError("errors must be numbers from 0 to infinity")
    if len(pairs) == 0:
        return
    if pairs.min() < 0 or pairs.max() >= count:
        raise ValueError(f"pairs must be from 0 to {count - 1}, got {pairs.min()} and {pairs.max()}")
    if (pairs[:, 0] == pairs[:, 1]).any():
        raise ValueError("pairs must join two different images")
    if len(np.unique(pairs, axis=0)) < len(pairs):
        raise ValueError("pairs must not repeat")
