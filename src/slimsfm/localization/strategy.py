"""What every way of matching a query against a map takes and gives."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64

from slimsfm.arrays import Descriptors, Ids, Image, Points2D
from slimsfm.features import Features
from slimsfm.pose import PoseEstimate


@dataclass(frozen=True, kw_only=True, eq=False)
class Query:
    """A query and its local features, the strongest first."""

    keypoints: Points2D
    """Pixels."""

    descriptors: Descriptors
    """Row i describes keypoint i."""

    features: Features
    """The features as the extractor gave them, in the same order."""

    camera: pycolmap.Camera
    """The intrinsics, or a guess of them where the focal length is not known."""

    image: Image | None = None
    """The image itself, for strategies that look at it; None where only its features are known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointMatches:
    """Matches between the keypoints of a query and the points of a map; a pair occurs once."""

    keypoints: Ids
    """Rows of the query's features, or of `points2D` where that is given."""

    points: Ids
    """Rows of the map's points."""

    references: int = 0
    """Reference images that the query was matched with to find them."""

    points2D: Float64[np.ndarray, "_ 2"] | None = None
    """Pixels of keypoints that a strategy found itself; None where they are the query's."""

    def pixels(self, query: Query) -> Points2D:
        """Where in the query each match is."""
        keypoints = query.keypoints if self.points2D is None else self.points2D
        return keypoints[self.keypoints]

    def __len__(self) -> int:
        return len(self.keypoints)

    @classmethod
    def none(cls) -> "PointMatches":
        """No matches."""
        nothing = np.zeros(0, np.int64)
        return cls(keypoints=nothing, points=nothing)


@dataclass(frozen=True, kw_only=True)
class MatchingOptions:
    """How strategies match."""

    matcher: str = "auto"
    """How the query and a reference image are matched; auto: by nearest neighbours, or without a detector
    where the map was built so."""

    retrieved: int = 2
    """Reference images that `retrieval` matches a query with."""

    def __post_init__(self) -> None:
        if self.retrieved < 1:
            raise ValueError(f"retrieved must be at least 1, got {self.retrieved}")


_SAME_PX = 4.0  # side of a square in which places of one point, each told by another image, are one

Target = tuple[Float32[np.ndarray, "_ d"], Int64[np.ndarray, " _"]]
"""Descriptors to match a query with, and the point of each, a row of the map's points."""

Rounds = Generator[PointMatches, PoseEstimate | None, None]
"""Yields matches, ever more of them; is sent the pose that the last ones gave."""


@runtime_checkable
class Strategy(Protocol):
    """Matches queries against one map. Created once per map, then called for every query, on any thread.

    A class may state what it requires of a map by the attribute `requires`: "points", described points that
    queries are matched with directly, or "features" (the default), features of the reference images.
    """

    def rounds(self, query: Query) -> Rounds:
        """Match a query in rounds, what promises most first.

        Each round yields all matches so far. The caller estimates the pose and stops when it is sure of it;
        else it sends the pose, or None, and the next round may look where that says.
        """
        ...

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """What a camera should see that stands there, as far as nothing hides it.

        Args:
            cam_from_world: The pose.
            agreeing: Points that agree with it, where they are known.
        """
        ...


@runtime_checkable
class PoseGuided(Protocol):
    """A strategy that looks at a part of the image of its own, where the pose says that the object is."""

    def near(self, query: Query, near_cam_from_world: pycolmap.Rigid3d) -> PointMatches:
        """Match a query that was taken about from there."""
        ...


def unite(parts: Sequence[PointMatches]) -> PointMatches:
    """Join matches from several sources; equal ones become one. Sorted by keypoint, then point.

    What strategies found themselves is equal where a point is found at the same place, to a pixel or two, by
    several sources: one match is left, at the mean of the places, so that nobody counts it twice.
    """
    keypoints = np.concatenate([np.zeros(0, np.int64), *_numbered_through(parts)])
    points = np.concatenate([np.zeros(0, np.int64), *(part.points for part in parts)])
    _, first = np.unique((keypoints << 32) | points, return_index=True)
    found = [part.points2D for part in parts if part.points2D is not None]
    references = sum(part.references for part in parts)
    if found:
        return _merged(np.concatenate(found)[keypoints[first]], points[first], references)
    return PointMatches(keypoints=keypoints[first], points=points[first], references=references)


def _merged(points2D: Points2D, points: Ids, references: int) -> PointMatches:
    """Matches of keypoints that strategies found themselves; each place of a point is one of its own."""
    places = np.column_stack([points, np.round(points2D / _SAME_PX).astype(np.int64)])
    unique, which, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(unique), 2))
    np.add.at(sums, which.ravel(), points2D)
    return PointMatches(
        keypoints=np.arange(len(unique)),
        points=unique[:, 0],
        references=references,
        points2D=sums / counts[:, None],
    )


def _numbered_through(parts: Sequence[PointMatches]) -> list[Ids]:
    """The parts' keypoints; those that strategies found themselves are rows of all such together."""
    numbered, start = [], 0
    for part in parts:
        numbered.append(part.keypoints + start)
        start += 0 if part.points2D is None else len(part.points2D)
    return numbered
