"""Edges from common points alone, for maps that have no matches.

A point that u and v both see is a 2D-3D match in either direction. A track joins more than any single pair
would match, so this errs towards too many edges.
"""

from functools import lru_cache

import numpy as np

from slimsfm.arrays import Ids, Points2D
from slimsfm.graph.candidates import covisible_pairs
from slimsfm.graph.source import GraphOptions, PairErrors, PairIndices, References
from slimsfm.mapping.map import Map

_CACHED_IMAGES = 256


class TrackEdges:
    """Localizes images from each other by the points they both see."""

    def __init__(self, map: Map, options: GraphOptions) -> None:
        self._references = References(map, options.ransac)
        self._min_points = options.ransac.min_inliers
        self._seen = lru_cache(_CACHED_IMAGES)(self._seen_by)

    def pairs(self) -> PairIndices:
        """The pairs that see enough common points for a pose."""
        return covisible_pairs(self._references.map, self._min_points)

    def errors(self, u: int, v: int) -> PairErrors:
        """Localize u and v from each other."""
        points_u, pixels_u = self._seen(u)
        points_v, pixels_v = self._seen(v)
        common, rows_u, rows_v = np.intersect1d(points_u, points_v, return_indices=True)
        return PairErrors(
            v_from_u=self._references.error(v, pixels_v[rows_v], common),
            u_from_v=self._references.error(u, pixels_u[rows_u], common),
        )

    def _seen_by(self, index: int) -> tuple[Ids, Points2D]:
        name = self._references.names[index]
        points2D, seen = self._references.map.images[name].points2D, self._references.map.observations[name]
        pixels = np.array([points2D[row].xy for row in seen.rows], np.float64).reshape(-1, 2)
        return seen.points, pixels
