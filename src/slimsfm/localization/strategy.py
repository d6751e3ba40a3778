"""What every way of matching a query against a map takes and gives."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Float32, Int64

from slimsfm.arrays import Descriptors, Ids, Points2D
from slimsfm.features import NearestOptions
from slimsfm.pose import PoseEstimate


@dataclass(frozen=True, kw_only=True, eq=False)
class Query:
    """The local features of a query, the strongest first."""

    keypoints: Points2D
    """Pixels."""

    descriptors: Descriptors
    """Row i describes keypoint i. Their memory is used again for the next query."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointMatches:
    """Matches between the keypoints of a query and the points of a map; a pair occurs once."""

    keypoints: Ids
    """Rows of the query's features."""

    points: Ids
    """Rows of the map's points."""

    references: int = 0
    """Reference images that the query was matched with to find them."""

    def __len__(self) -> int:
        return len(self.keypoints)

    @classmethod
    def none(cls) -> "PointMatches":
        """No matches."""
        return unite([])


@dataclass(frozen=True, kw_only=True)
class MatchingOptions:
    """How strategies match."""

    nearest: NearestOptions = NearestOptions()
    """Which nearest neighbours are matches."""

    retrieved: int = 2
    """Reference images that `retrieval` matches a query with."""

    def __post_init__(self) -> None:
        if self.retrieved < 1:
            raise ValueError(f"retrieved must be at least 1, got {self.retrieved}")


Target = tuple[Float32[np.ndarray, "_ d"], Int64[np.ndarray, " _"]]
"""Descriptors to match a query with, and the point of each, a row of the map's points."""

Rounds = Generator[PointMatches, PoseEstimate | None, None]
"""Yields matches, ever more of them; is sent the pose that the last ones gave."""


@runtime_checkable
class Strategy(Protocol):
    """Matches queries against one map. Made once for a map, then called for every query, on any thread."""

    def rounds(self, query: Query) -> Rounds:
        """Match a query in rounds, what promises most first.

        Each round yields all matches so far. The caller estimates the pose and stops when it is sure of it;
        else it sends the pose, or None, and the next round may look where that says.
        """
        ...

    def expected(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """What a camera should see that stands there, as far as nothing hides it.

        Args:
            cam_from_world: The pose.
            agreeing: Points that agree with it, where they are known.
        """
        ...


def unite(parts: list[Int64[np.ndarray, "_ 2"]], references: int = 0) -> PointMatches:
    """Join pairs (keypoint, point) from several sources; equal ones become one. Sorted."""
    pairs = np.concatenate([np.zeros((0, 2), np.int64), *parts])
    _, first = np.unique((pairs[:, 0] << 32) | pairs[:, 1], return_index=True)
    pairs = pairs[first]
    return PointMatches(keypoints=pairs[:, 0], points=pairs[:, 1], references=references)
