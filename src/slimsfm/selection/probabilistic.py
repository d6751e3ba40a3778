"""Probabilistic K-cover [1]: every image very likely matches at least K of the chosen points.

A point that an image can use is matched, when a query looks like the image, with a probability: matches are
independent, so that their number follows a Poisson binomial distribution. [1] takes one probability for all
points and also weighs descriptors; here it is the point's own, and descriptors are judged before, when it is
found who can use a point.

References:
    [1] Cao and Snavely, Minimal Scene Descriptions from Structure from Motion Models, CVPR 2014.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from slimsfm.arrays import Ids
from slimsfm.selection.lazy import Gains, greedy_order
from slimsfm.selection.problem import SelectionProblem, check_count, most_cover

_SURE = 0.99  # probability of K matches at which an image is covered, as in [1]
_ROUNDING = 1e-9


def probabilistic(problem: SelectionProblem, count: int, *, seed: int = 0) -> Ids:  # noqa: ARG001
    """Choose points of which every image very likely matches many.

    Two stages for one K, both greedy [1]: until every image expects K matches, the point that adds most to
    the expectations of those which do not; then, until every image has K matches with probability 0.99, the
    point that adds most to the probabilities of those which have not. An image that cannot get there uses all
    it can. K is the largest at which `count` points suffice, and what is left goes towards K + 1.

    Args:
        problem: The points and who can use them.
        count: How many points are wanted.
        seed: Unused; nothing is left to chance.

    Returns:
        Points in the order of their choice, ties by the lower point.

    Raises:
        ValueError: `count` is not positive.

    Notes:
        Once an image expects K matches, K - 1 lies below the mode of their number, so its probability, to
        which a further point's gain is proportional, only falls: lazy evaluation is exact in both stages.
        O(log K) rounds for one budget, each of O(uses + points) and of O(K x images of a point) a choice.
    """
    check_count(count)
    most = int(problem.points_an_image.max(initial=0))
    low, high = 0, most_cover(problem, count)
    widest = min(high + 1, most)
    choice = _Choice(problem, widest)
    while low < high:
        middle = (low + high + 1) // 2
        tried = _Choice(problem, widest)
        if tried.extend(middle, count + 1) <= count:
            low, choice = middle, tried
        else:
            high = middle - 1
    while len(choice.chosen) < count and low < widest:
        low += 1
        choice.extend(low, count)
    return np.array(choice.chosen, np.int64)


def match_probabilities(problem: SelectionProblem) -> Float64[np.ndarray, " points"]:
    """How likely the next image that should match a point does.

    Laplace's rule of succession: (n + 1) / (n + 2) for a point that n images can use. It knows of no
    failures, because the problem does not, so it ranks points rather than telling their true rates.
    """
    uses = np.diff(problem.images_of.starts)
    return (uses + 1) / (uses + 2)


class _Choice:
    """The points chosen so far and the distribution of each image's number of matches."""

    def __init__(self, problem: SelectionProblem, widest: int) -> None:
        self.chosen: list[int] = []
        self._problem = problem
        self._of = problem.images_of
        self._probability = match_probabilities(problem)
        self._free = np.ones(problem.num_points, bool)
        self._expected = np.zeros(problem.num_images)
        self._exactly = np.zeros(
            (problem.num_images, widest)
        )  # [i, k]: image i has k matches, for k < widest
        self._exactly[:, :1] = 1

    def extend(self, cover: int, count: int) -> int:
        """Choose until `count` points are chosen or all images are covered; gives the number chosen."""
        self._cover = cover
        for weigh in (self._not_expecting, self._last_missing):
            self._weigh = weigh
            for point in self._order():
                if len(self.chosen) >= count:
                    return len(self.chosen)
                self._choose(point)
        return len(self.chosen)

    def _not_expecting(self, images: Ids) -> Gains:
        return (self._expected[images] < self._cover - _ROUNDING).astype(np.float64)

    def _last_missing(self, images: Ids) -> Gains:
        """The probability of K - 1 matches, if that of fewer than K is still too large."""
        fewer = self._exactly[images, : self._cover]
        return np.where(fewer.sum(axis=1) > 1 - _SURE, fewer[:, -1], 0)

    def _order(self) -> Iterator[int]:
        problem = self._problem
        self._weight = self._weigh(np.arange(problem.num_images))
        uses = np.repeat(self._weight, problem.points_an_image)
        gains = self._probability * np.bincount(problem.usable.indices, uses, problem.num_points)
        return greedy_order(gains * (1 + _ROUNDING), self._gains, self._free)

    def _gains(self, points: Ids) -> Gains:
        at, owners = self._of.all_at(points)
        weights = np.bincount(owners, self._weight[self._of.images[at]], minlength=len(points))
        return self._probability[points] * weights

    def _choose(self, point: int) -> None:
        images, probability = self._of.images[self._of.at(point)], self._probability[point]
        self.chosen.append(point)
        self._free[point] = False
        self._expected[images] += probability
        before = self._exactly[images]
        self._exactly[images] = before * (1 - probability)
        self._exactly[images, 1:] += before[:, :-1] * probability
        self._weight[images] = self._weigh(images)
