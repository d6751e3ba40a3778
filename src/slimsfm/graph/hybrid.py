"""Edges from stored matches, and from localizing anew just where those leave it open."""

import numpy as np

from slimsfm.graph.candidates import covisible_pairs
from slimsfm.graph.localize import LocalizeEdges
from slimsfm.graph.matches import MatchEdges
from slimsfm.graph.source import GraphOptions, PairErrors, PairIndices
from slimsfm.mapping.map import Map

_NEAR = 2.0  # errors within this factor of the threshold may fall either way
_MIN_COMMON_POINTS = 20  # of a pair without matches that is worth matching anew


class HybridEdges:
    """Asks stored matches first.

    They leave an edge open where it has none although its images see enough common points, where fewer become
    2D-3D matches than a pose needs, where they give no pose, and where an error is near the threshold.
    """

    def __init__(self, map: Map, options: GraphOptions) -> None:
        self._map = map
        self._options = options
        self._matches = MatchEdges(map, options)
        self._localize = LocalizeEdges(map, options)
        self._matched = {(int(u), int(v)) for u, v in self._matches.pairs()}

    def pairs(self) -> PairIndices:
        """The pairs that have matches, or see enough common points."""
        covisible = covisible_pairs(self._map, _MIN_COMMON_POINTS)
        return np.unique(np.concatenate([self._matches.pairs(), covisible]), axis=0)

    def errors(self, u: int, v: int) -> PairErrors:
        """Localize u and v from each other."""
        if (min(u, v), max(u, v)) not in self._matched:
            return self._localize.errors(u, v)
        found = self._matches.errors(u, v)
        v_from_u, u_from_v = found.v_from_u, found.u_from_v
        return PairErrors(
            v_from_u=v_from_u if self._is_decided(v_from_u) else self._localize.error(u, v),
            u_from_v=u_from_v if self._is_decided(u_from_v) else self._localize.error(v, u),
        )

    def _is_decided(self, error: float) -> bool:
        threshold = self._options.threshold
        return error < threshold / _NEAR or threshold * _NEAR < error < np.inf
