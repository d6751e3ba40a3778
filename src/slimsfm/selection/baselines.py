"""Baselines: K-cover [1] and random points.

References:
    [1] Li, Snavely and Huttenlocher, Location Recognition using Prioritized Feature Matching, ECCV 2010.
"""

from collections.abc import Iterator

import numpy as np

from slimsfm.arrays import Ids, Mask
from slimsfm.selection.lazy import Gains, greedy_order
from slimsfm.selection.problem import SelectionProblem, check_point_count, most_cover


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
        return greedy_order(self._gains, self._now, self.free)

    def _now(self, points: Ids) -> Gains:
        return self._gains[points]


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
