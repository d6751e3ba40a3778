"""The selectors: pose information, K-cover and random points.

A use of a point by an image, with twist J, adds the information J'J to the image's pose. Its value is 1 + w
log det(I + J C J'), where C is the covariance of the pose given the points chosen so far: one more match for
the image, and the information of that match, which is small near points that are chosen already. Points are
chosen greedily by the value of their uses in all images that are not satisfied so far. An image is satisfied
when it can use K of the chosen points, or all of its points if they are fewer, and when its predicted corner
error is as small as with K random points of its own.
"""

from bisect import bisect_right
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from slimsfm.arrays import Ids, Mask
from slimsfm.pose import rms_corner_errors
from slimsfm.selection.problem import (
    PRIOR_SIGMA,
    Gains,
    SelectionProblem,
    Twists,
    check_point_count,
    greedy_order,
    most_cover,
)

_WEIGHT = 0.5  # of the information of a match relative to its count
_FIRST_COVER = 8  # points per image
_GROWTH = 1.25  # from one K to the next


def information(problem: SelectionProblem, count: int, *, seed: int = 0) -> Ids:  # noqa: ARG001
    """Choose the points that determine the poses of all images best.

    K is the largest of 8, 10, 13, ... at which `count` points satisfy all images; the remaining points are
    spent on the next K. The choice is deterministic.

    Args:
        problem: The points and the images that can use them.
        count: Number of points to choose.
        seed: Unused.

    Returns:
        Points in the order of their choice.

    Raises:
        ValueError: `count` is not positive.

    Notes:
        A round evaluates every use once and then gains, which never rise, lazily: some hundred per choice in
        practice. There are O(log log(points per image)) rounds; a round that exceeds `count` is stopped.
    """
    check_point_count(count)
    covers = _covers(problem)
    choice = InformationChoice(problem)
    low, high = 0, max(bisect_right(covers, most_cover(problem, count)) - 1, 0)
    while low < high:
        middle = (low + high + 1) // 2
        tried = InformationChoice(problem)
        if tried.extend(covers[middle], count + 1) <= count:
            low, choice = middle, tried
        else:
            high = middle - 1
    for cover in covers[low:]:
        if choice.extend(cover, count) >= count:
            break
    return np.array(choice.chosen, np.int64)


def _covers(problem: SelectionProblem) -> list[int]:
    """The values of K to try; the last one requires every point that an image can use."""
    most = int(problem.points_per_image.max(initial=1))
    covers = [_FIRST_COVER]
    while covers[-1] < most:
        covers.append(min(int(np.ceil(covers[-1] * _GROWTH)), most))
    return covers


class InformationChoice:
    """The points chosen so far and their effect on each image."""

    def __init__(self, problem: SelectionProblem) -> None:
        self.chosen: list[int] = []
        self._problem = problem
        self._of = problem.images_of
        self._twists = problem.twists
        self._precision = np.tile(np.eye(6) / PRIOR_SIGMA**2, (problem.num_images, 1, 1))
        self._covariance = np.tile(np.eye(6) * PRIOR_SIGMA**2, (problem.num_images, 1, 1))
        self._error = rms_corner_errors(self._covariance, problem.corner_twists)
        self._seen = np.zeros(problem.num_images, np.int64)
        self._free = np.ones(problem.num_points, bool)

    def extend(self, cover: int, count: int) -> int:
        """Choose until `count` points are chosen or all images are satisfied; returns the number chosen."""
        for point in self._order(cover):
            if len(self.chosen) >= count:
                break
            self._choose(point)
        return len(self.chosen)

    def _order(self, cover: int) -> Iterator[int]:
        usable = self._problem.points_per_image
        self._needed = np.minimum(cover, usable)
        self._target = self._problem.best_corner_errors * np.sqrt(np.maximum(usable / cover, 1)) * (1 + 1e-6)
        self._open = (self._seen < self._needed) | (self._error > self._target)
        return greedy_order(self._all_gains(), self._gains, self._free)

    def _choose(self, point: int) -> None:
        at = self._of.at(point)
        images, twists = self._of.images[at], self._twists[self._of.uses[at]].astype(np.float64)
        self.chosen.append(point)
        self._free[point] = False
        self._seen[images] += 1
        self._precision[images] += twists.transpose(0, 2, 1) @ twists
        self._covariance[images] = np.linalg.inv(self._precision[images])
        self._error[images] = rms_corner_errors(self._covariance[images], self._problem.corner_twists[images])
        self._open[images] = (self._seen[images] < self._needed[images]) | (
            self._error[images] > self._target[images]
        )

    def _gains(self, points: Ids) -> Gains:
        at, owners = self._of.all_at(points)
        still_open = self._open[self._of.images[at]]
        at, owners = at[still_open], owners[still_open]
        worth = _worth(self._twists[self._of.uses[at]], self._covariance[self._of.images[at]])
        return np.bincount(owners, worth, minlength=len(points)).astype(np.float64)

    def _all_gains(self) -> Gains:
        """Upper bounds of the gains of all points, slightly raised against rounding errors."""
        gains = np.zeros(self._problem.num_points)
        starts = self._problem.usable.indptr
        for image in np.flatnonzero(self._open):
            uses = slice(starts[image], starts[image + 1])
            covariance = self._covariance[image][None]
            gains[self._problem.usable.indices[uses]] += _worth(self._twists[uses], covariance)
        return gains * (1 + 1e-9)


def _worth(twists: Twists, covariances: Float64[np.ndarray, "m 6 6"]) -> Gains:
    """The value of uses to poses of these covariances, one per use or one for all."""
    pixels = twists.astype(np.float64)
    moved = pixels @ covariances
    (u, v), uv = np.vecdot(moved, pixels).T, np.vecdot(moved[:, 0], pixels[:, 1])
    return 1 + _WEIGHT * np.log((1 + u) * (1 + v) - uv**2)


def kcover(problem: SelectionProblem, count: int, *, seed: int = 0) -> Ids:  # noqa: ARG001
    """Choose points so that every image can use at least K of them.

    Greedily chooses the point that most images with fewer than K chosen points can use [1], where K is capped
    at the number of points that an image can use at all. K is fixed in [1]; here it is the largest at which
    `count` points suffice, and the remaining points are spent on K + 1. The choice is deterministic.

    Args:
        problem: The points and the images that can use them.
        count: Number of points to choose.
        seed: Unused.

    Returns:
        Points in the order of their choice, ties by the lower point.

    Raises:
        ValueError: `count` is not positive.

    Notes:
        The greedy set for one K is at most 1 + ln(images of the most used point) times as large as the
        smallest [2]. There are O(log K) rounds, each of O(uses + points) in practice.

    References:
        [2] Wolsey, An analysis of the greedy algorithm for the submodular set covering problem, 1982.
    """
    check_point_count(count)
    low, high, cover = 0, most_cover(problem, count), KCover(problem)
    while low < high:
        middle = (low + high + 1) // 2
        tried = KCover(problem)
        if tried.extend(middle, count + 1) <= count:
            low, cover = middle, tried
        else:
            high = middle - 1
    most = int(problem.points_per_image.max(initial=0))
    while len(cover.chosen) < count and low < most:
        low += 1
        cover.extend(low, count)
    return np.array(cover.chosen, np.int64)


class KCover:
    """Chooses points until every image can use K of them, or all of its points."""

    def __init__(self, problem: SelectionProblem) -> None:
        self.chosen: list[int] = []
        self.free: Mask = np.ones(problem.num_points, bool)
        """Whether each point is still free."""
        self._problem = problem
        self._seen = np.zeros(problem.num_images, np.int64)
        self._needed = np.zeros(problem.num_images, np.int64)
        self._gains = np.zeros(problem.num_points)

    def extend(self, cover: int, count: int) -> int:
        """Choose until `count` points are chosen or all images are covered; returns the number chosen."""
        for point in self._order(cover):
            if len(self.chosen) >= count:
                break
            self.choose(point)
        return len(self.chosen)

    def choose(self, point: int) -> None:
        """Add a point to the chosen ones."""
        self.chosen.append(point)
        self.free[point] = False
        of = self._problem.images_of
        images = of.images[of.at(point)]
        self._seen[images] += 1
        starts = self._problem.usable.indptr
        for image in images[self._seen[images] == self._needed[images]].tolist():
            self._gains[self._problem.usable.indices[starts[image] : starts[image + 1]]] -= 1

    def _order(self, cover: int) -> Iterator[int]:
        usable = self._problem.points_per_image
        self._needed = np.minimum(cover, usable)
        open_uses = np.repeat(self._seen < self._needed, usable)
        self._gains = np.bincount(
            self._problem.usable.indices[open_uses], minlength=self._problem.num_points
        ).astype(np.float64)
        return greedy_order(self._gains, self._gains.__getitem__, self.free)


def random_points(problem: SelectionProblem, count: int, *, seed: int = 0) -> Ids:
    """Draw points uniformly, without replacement, from those that any image can use.

    Args:
        problem: The points and the images that can use them.
        count: Number of points to choose.
        seed: Equal problems and seeds give equal points; a smaller count gives a prefix of them.

    Returns:
        Points in the order of the draw.

    Raises:
        ValueError: `count` is not positive.
    """
    check_point_count(count)
    usable = np.flatnonzero(np.diff(problem.images_of.starts))
    return np.random.default_rng(seed).permutation(usable)[:count]
