"""The selection problem, which of many 3D points keep poses well determined, and lazy greedy selection."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.sparse import csr_array

from slimsfm.arrays import Ids, Mask
from slimsfm.pose import rms_corner_errors

Gains = Float64[np.ndarray, " n"]
Some = Int64[np.ndarray, " m"]

_NEGLIGIBLE = 1e-9
_FRONT = 4096  # items with the largest bounds, among which the best is searched; at least a share of all
_SHARE = 64
_BATCH = 32  # gains evaluated at once; doubled each time that they do not decide


def greedy_order(first_gains: Gains, gains: Callable[[Ids], Gains], allowed: Mask) -> Iterator[int]:
    """Yield the item of the largest gain repeatedly, until no item has a gain.

    Args:
        first_gains: Upper bounds of the gains.
        gains: The current gains of items; they must not rise when items are chosen.
        allowed: Which items may be chosen.

    Notes:
        The caller must apply the choice of an item before it requests the next one. Ties go to the lower
        index. Bounds are kept for all items but searched only among the largest, some thousands, until those
        have fallen below the rest; gains are evaluated in batches, at most about twice as many as in [1].
    """
    bounds = np.where(allowed, first_gains, 0.0)
    while bounds.max(initial=0.0) > _NEGLIGIBLE:
        front, rest = _largest(bounds)
        yield from _from_front(bounds, front, rest, gains)


def _largest(bounds: Gains) -> tuple[Some, int | None]:
    """The items of the largest bounds, ascending, and the best of the rest; ties are broken by index."""
    size = max(_FRONT, len(bounds) // _SHARE)
    if len(bounds) <= size:
        return np.arange(len(bounds)), None
    last = -np.partition(-bounds, size)[size]
    above, equal = np.flatnonzero(bounds > last), np.flatnonzero(bounds == last)
    room = size - len(above)
    return np.sort(np.concatenate([above, equal[:room]])), int(equal[room])


def _from_front(bounds: Gains, front: Some, rest: int | None, gains: Callable[[Ids], Gains]) -> Iterator[int]:
    """Yield the best items as long as they lie in the front, then bring its bounds up to date."""
    values = bounds[front]
    fresh, size = np.zeros(len(front), bool), _BATCH
    while True:
        place = int(values.argmax())
        item, gain = int(front[place]), float(values[place])
        if gain <= _NEGLIGIBLE or (rest is not None and (-float(bounds[rest]), rest) < (-gain, item)):
            break  # nothing gains, or the best of the rest comes first
        if fresh[place]:
            values[place] = 0.0
            yield item
            fresh[:], size = False, _BATCH
        else:
            batch = _stale(values, fresh, size)
            values[batch] = gains(front[batch])
            fresh[batch] = True
            size *= 2
    bounds[front] = values


def _stale(bounds: Gains, fresh: Mask, size: int) -> Some:
    """Up to `size` places of the largest bounds that are not fresh but may be above all that are."""
    stale = np.flatnonzero(~fresh & (bounds >= bounds[fresh].max(initial=_NEGLIGIBLE)))
    if len(stale) <= size:
        return stale
    return stale[np.argpartition(-bounds[stale], size)[:size]]


Twists = Float32[np.ndarray, "n 2 6"]
"""Pixels by which a point's image moves per unit of a camera's motion: rotation in radians, then translation
in diagonals of the box, both in the camera's frame."""

PRIOR_SIGMA = 0.01
"""Standard deviation of each of a pose's six parameters, radians or diagonals, before any point is seen."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SelectionProblem:
    """Points, the images that can use them, and the information of each use on the image's pose.

    Raises:
        ValueError: The lengths of the arrays do not match.
    """

    usable: csr_array
    """Boolean [images, points] in canonical form: the image finds the point by its descriptor."""

    twists: Twists
    """Row i belongs to the i-th true entry of `usable`."""

    corner_twists: Float32[np.ndarray, "images 24 6"]
    """How the coordinates of the box's corners, in diagonals, move with each image's pose."""

    def __post_init__(self) -> None:
        if len(self.twists) != self.usable.nnz:
            raise ValueError(
                f"twists must have a row for each of {self.usable.nnz} uses, got {len(self.twists)}"
            )
        if len(self.corner_twists) != self.num_images:
            raise ValueError(
                f"corner_twists must have a row for each of {self.num_images} images, "
                f"got {len(self.corner_twists)}"
            )

    @property
    def num_images(self) -> int:
        """Number of images."""
        return len(self.usable.indptr) - 1

    @property
    def num_points(self) -> int:
        """Number of points."""
        return (self.usable.shape or (0, 0))[1]  # scipy declares that it may be None

    @cached_property
    def points_per_image(self) -> Int64[np.ndarray, " images"]:
        """How many points each image can use."""
        return np.diff(self.usable.indptr).astype(np.int64)

    @cached_property
    def images_of(self) -> "ImagesOfPoints":
        """The uses point by point."""
        usable = self.usable
        images = np.repeat(np.arange(self.num_images), np.diff(usable.indptr))
        order = np.argsort(usable.indices, kind="stable")
        starts = np.searchsorted(usable.indices[order], np.arange(self.num_points + 1))
        return ImagesOfPoints(images=images[order], uses=order, starts=starts)

    def information(self, points: Ids | None = None) -> Float64[np.ndarray, "images 6 6"]:
        """Information on each image's pose from the prior and the chosen points (None: all), at 1 px."""
        total = np.tile(np.eye(6) / PRIOR_SIGMA**2, (self.num_images, 1, 1))
        wanted = np.ones(self.num_points, bool)
        if points is not None:
            wanted[:] = False
            wanted[points] = True
        starts = self.usable.indptr
        for image in range(self.num_images):
            uses = slice(starts[image], starts[image + 1])
            twists = self.twists[uses][wanted[self.usable.indices[uses]]].reshape(-1, 6)
            total[image] += twists.T @ twists
        return total

    @cached_property
    def best_corner_errors(self) -> Float64[np.ndarray, " images"]:
        """Predicted corner error of each image's pose from all points that it can use."""
        return self.corner_errors()

    def corner_errors(self, points: Ids | None = None) -> Float64[np.ndarray, " images"]:
        """Predicted corner error of each image's pose from the chosen points (None: all) it can use."""
        return rms_corner_errors(np.linalg.inv(self.information(points)), self.corner_twists)


@dataclass(frozen=True, kw_only=True, eq=False)
class ImagesOfPoints:
    """The uses of `SelectionProblem.usable` by point; those of point p are `starts[p]:starts[p + 1]`."""

    images: Int64[np.ndarray, " uses"]
    """The image of each use."""

    uses: Int64[np.ndarray, " uses"]
    """Row of each use in `SelectionProblem.twists`."""

    starts: Int64[np.ndarray, " points_and_1"]
    """Where each point's uses begin."""

    def at(self, point: int) -> slice:
        """Where the uses of a point lie."""
        return slice(self.starts[point], self.starts[point + 1])

    def all_at(self, points: Ids) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"]]:
        """Where the uses of points lie, and for each of them which of the points it belongs to."""
        counts = self.starts[points + 1] - self.starts[points]
        owners = np.repeat(np.arange(len(points)), counts)
        first = self.starts[points] - (np.cumsum(counts) - counts)
        return first[owners] + np.arange(len(owners)), owners


class Selector(Protocol):
    """A method that chooses points."""

    def __call__(self, problem: SelectionProblem, count: int, *, seed: int = 0) -> Ids:
        """Choose points.

        Args:
            problem: The points and the images that can use them.
            count: Number of points to choose.
            seed: Equal problems and seeds give equal points.

        Returns:
            Points in the order of their choice, the best first. They are fewer than `count` only if no image
            can use any further point.
        """
        ...


def check_point_count(count: int) -> None:
    """Check a number of points.

    Raises:
        ValueError: `count` is not positive.
    """
    if count < 1:
        raise ValueError(f"count must be positive, got {count}")


def most_cover(problem: SelectionProblem, count: int) -> int:
    """An upper bound of the K for which `count` points can be such that each image uses K, or all it can.

    The most used points must have as many uses as the images require.
    """
    images_a_point = np.sort(np.diff(problem.images_of.starts))
    images_of_at_least = np.bincount(problem.points_per_image)[::-1].cumsum()[::-1][1:]
    wanted = np.cumsum(images_of_at_least)
    return int(np.searchsorted(wanted, images_a_point[::-1][:count].sum(), side="right"))
