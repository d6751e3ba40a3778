"""What every way of matching a query against a map takes and gives."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64

from slimsfm.arrays import Descriptors, Ids


@dataclass(frozen=True, kw_only=True, eq=False)
class PointMatches:
    """Matches between the keypoints of a query and the points of a map; a pair occurs once."""

    keypoints: Ids
    """Rows of the query's features."""

    points: Ids
    """Rows of the map's points."""

    def __len__(self) -> int:
        return len(self.keypoints)


@runtime_checkable
class Strategy(Protocol):
    """Matches queries against one map. Made once for a map, then called for every query."""

    def match(self, descriptors: Descriptors) -> PointMatches:
        """Match the query's descriptors, rows of unit length, against the map.

        Their memory is used again for the next query.
        """
        ...


def unite(parts: list[Int64[np.ndarray, "_ 2"]]) -> PointMatches:
    """Join pairs (keypoint, point) from several sources; equal ones become one. Sorted."""
    pairs = np.unique(np.concatenate([np.zeros((0, 2), np.int64), *parts]), axis=0)
    return PointMatches(keypoints=pairs[:, 0], points=pairs[:, 1])
