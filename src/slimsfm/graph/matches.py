"""Edges from the verified matches that a map already has.

A match of a keypoint of u that sees a point, with a keypoint of v, is a 2D-3D match of v. Each pair is read
once and serves both directions. A pair without stored matches has no edge.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Int64

from slimsfm.arrays import Ids, Points2D
from slimsfm.graph.source import GraphOptions, PairErrors, PairIndices, References
from slimsfm.mapping.map import Map

_CACHED_IMAGES = 256
_MOST_MATCHES = 100  # that a pose is estimated from; they are verified, so more add hardly anything


class MatchEdges:
    """Localizes images from each other by their stored matches. Cost: one pose a direction, no matching."""

    def __init__(self, map: Map, options: GraphOptions) -> None:
        self._references = References(map, options.ransac)
        self._points = lru_cache(_CACHED_IMAGES)(self._references.points_of)

    def pairs(self) -> PairIndices:
        """The pairs that have stored matches."""
        index = self._references.index
        found = [(index[a], index[b]) for a, b in self._references.map.matches if a in index and b in index]
        pairs = np.array(found, np.int64).reshape(-1, 2)
        return np.unique(np.sort(pairs, axis=1), axis=0)

    def errors(self, u: int, v: int) -> PairErrors:
        """Localize u and v from each other."""
        rows_u, rows_v = self._matches(u, v).T
        return PairErrors(
            v_from_u=self._error(u, rows_u, v, rows_v), u_from_v=self._error(v, rows_v, u, rows_u)
        )

    def _error(self, reference: int, reference_rows: np.ndarray, query: int, query_rows: np.ndarray) -> float:
        points = self._points(reference)[reference_rows]
        sees = np.flatnonzero(points >= 0)
        used = sees[:: max(1, -(-len(sees) // _MOST_MATCHES))]
        return self._references.error(query, self._pixels(query, query_rows[used]), points[used])

    def _matches(self, u: int, v: int) -> Int64[np.ndarray, "n 2"]:
        matches, names = self._references.map.matches, self._references.names
        if (names[u], names[v]) in matches:
            return matches[names[u], names[v]]
        return matches[names[v], names[u]][:, ::-1]

    def _pixels(self, index: int, rows: Ids) -> Points2D:
        points2D = self._references.map.images[self._references.names[index]].points2D
        return np.array([points2D[row].xy for row in rows.tolist()], np.float64).reshape(-1, 2)
