"""Interface of strategies: what matching a query against a map takes and returns."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64

from slimsfm.arrays import Descriptors, Ids, Image, Points2D, evenly_spaced
from slimsfm.features import Features
from slimsfm.pose import PoseEstimate


@dataclass(frozen=True, kw_only=True, eq=False)
class Query:
    """A query and its local features, strongest keypoint first."""

    keypoints: Points2D
    """Pixels."""

    descriptors: Descriptors
    """Row i describes keypoint i."""

    features: Features
    """The features as the extractor returned them, in the same order."""

    camera: pycolmap.Camera
    """The intrinsics; a guess where the focal length is unknown."""

    image: Image | None = None
    """The image, for strategies that use it; None if only its features are known."""

    shrink_factor: float = 1.0
    """Pixels of the image per pixel in which features were found; keypoints are as exact as the latter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointMatches:
    """Matches between keypoints of a query and points of a map; no pair occurs twice."""

    keypoints: Ids
    """Rows of the query's features, or of `points2D` if that is given."""

    points: Ids
    """Rows of the map's points."""

    references: int = 0
    """Number of reference images that the query was matched with."""

    points2D: Float64[np.ndarray, "_ 2"] | None = None
    """Pixels of keypoints that the strategy found itself; None if they are the query's."""

    shrink_factor: float = np.inf
    """Pixels of the image per pixel in which the strategy found `points2D`, if less than the query's."""

    def pixels(self, query: Query) -> Points2D:
        """Pixels of the matches in the query."""
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
    """Matcher for a query and a reference image. auto: nearest neighbors, or without a detector if the map
    was built that way."""

    retrieved: int = 2
    """Number of reference images that `retrieval` matches a query with."""

    def __post_init__(self) -> None:
        if self.retrieved < 1:
            raise ValueError(f"retrieved must be at least 1, got {self.retrieved}")


_SAME_PX = 4.0  # side of a square in which several images' positions of a point count as one

Target = tuple[Float32[np.ndarray, "_ d"], Int64[np.ndarray, " _"]]
"""Descriptors to match a query with, and for each the row of its point in the map.

If the points are in ascending order, rows of one point are its appearances: the best one counts, and they are
no rivals. Otherwise they are keypoints of an image that sees the point twice, and each is matched by itself.
"""


def first_rows(points: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " _"]:
    """The first of each point's appearances in a target; all rows, if these are keypoints of an image."""
    steps = np.diff(points, prepend=-1)
    return np.flatnonzero(steps) if np.all(steps >= 0) else np.arange(len(points))


def some_points(points: Int64[np.ndarray, " n"], most: int) -> Int64[np.ndarray, " _"]:
    """Rows of at most `most` points of a target, evenly spaced, with all appearances of each."""
    firsts = first_rows(points)
    counts = np.diff(firsts, append=len(points))
    chosen = np.zeros(len(firsts), bool)
    chosen[evenly_spaced(len(firsts), most)] = True
    return np.flatnonzero(np.repeat(chosen, counts))


Rounds = Generator[PointMatches, PoseEstimate | None, None]
"""Yields matches, more in each round; receives the pose estimated from the last ones."""


@runtime_checkable
class Strategy(Protocol):
    """Matches queries against one map. Created once per map, then called for every query, on any thread.

    A class may state what it requires of a map by the attribute `requires`: "points", described points that
    queries are matched with directly, or "features" (the default), features of the reference images.
    """

    def rounds(self, query: Query) -> Rounds:
        """Match a query in rounds, the most likely matches first.

        Each round yields all matches so far. The caller estimates the pose and stops if it is sure of it.
        Otherwise it sends the pose, or None, and the next round may use it to decide where to look.
        """
        ...

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """The points that a camera with this pose should see if nothing hides them.

        Args:
            cam_from_world: The pose.
            agreeing: Rows of points that agree with the pose, if known.
        """
        ...


@runtime_checkable
class PoseGuided(Protocol):
    """A strategy that, given a pose, examines the part of the image that shows the object."""

    def near(self, query: Query, near_cam_from_world: pycolmap.Rigid3d) -> PointMatches:
        """Match a query whose pose is approximately known."""
        ...


def unite(parts: Sequence[PointMatches], pixel: float = 1.0) -> PointMatches:
    """Join matches from several sources and drop duplicates. Sorted by keypoint, then point.

    Matches at keypoints that strategies found themselves count as duplicates if they put the same point at
    the same position, to a pixel or two. One match at the mean position replaces them, so that it counts
    once.

    Args:
        parts: The matches.
        pixel: Side of a pixel in which they were found, in pixels of the query.
    """
    keypoints = np.concatenate([np.zeros(0, np.int64), *_numbered_through(parts)])
    points = np.concatenate([np.zeros(0, np.int64), *(part.points for part in parts)])
    _, first = np.unique((keypoints << 32) | points, return_index=True)
    found = [part.points2D for part in parts if part.points2D is not None]
    references = sum(part.references for part in parts)
    if found:
        return _merged(np.concatenate(found)[keypoints[first]], points[first], references, _SAME_PX * pixel)
    return PointMatches(keypoints=keypoints[first], points=points[first], references=references)


def _merged(points2D: Points2D, points: Ids, references: int, side_px: float) -> PointMatches:
    """Merge matches that put a point at the same position; each remaining one gets its own keypoint."""
    places = np.column_stack([points, np.round(points2D / side_px).astype(np.int64)])
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
    """Keypoints per part; rows of `points2D` become rows of all parts' `points2D` stacked."""
    numbered, start = [], 0
    for part in parts:
        numbered.append(part.keypoints + start)
        start += 0 if part.points2D is None else len(part.points2D)
    return numbered
