"""Which image size to extract the first features of a query from, found on references that are left out.

Extraction takes time in proportion to the pixels. A shrunken image has the keypoints of the whole one whose
scale is still large enough after shrinking, so a map without photos can tell how many of its references
an image of each size would localize, and how exactly.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from threadpoolctl import threadpool_limits

from slimsfm.arrays import evenly_spaced
from slimsfm.localization.extraction import FIRST_SIZES, first_size, second_size
from slimsfm.localization.round_result import ACCURATE
from slimsfm.pose import PoseEstimate

_MOST_TESTS = 30
_SURE_INLIERS = 12  # of a pose that is sure enough to stop, hardly ever less
_ROUND = 160**2  # pixels whose extraction takes as long as matching and pose of one round
_AS_EXACT = 1.2  # times the error with the whole image, at which a smaller first image is preferred


@dataclass(frozen=True, kw_only=True)
class FirstSize:
    """What queries cost if their first image has a certain size."""

    size: int
    """Longer side of the first image, in pixels."""

    pixels: float
    """Pixels extracted per query on average, and what each round costs besides, in pixels."""

    error: float
    """Median of the predicted corner error of the poses that end the search."""


@dataclass(frozen=True, kw_only=True)
class SizedTests:
    """How references that are left out are localized by images of several sizes."""

    whole: int
    """Longer side of the image from which features are extracted at once."""

    names: tuple[str, ...]
    """The references."""

    localize: Callable[[str, int], PoseEstimate | None]
    """Localizes one of them by the keypoints that an image with this longer side has."""

    share: Callable[[str], float]
    """Share of the image of one of them that shows points of the map."""

    predicted_error: Callable[[PoseEstimate], float]
    """Relative corner error of a pose, if its inliers are right."""

    extract_seconds: Callable[[int], float]
    """Time of extracting features from an image with this longer side."""


class SizeTrials:
    """Tries sizes of the first image on references that are left out."""

    def __init__(self, tests: SizedTests) -> None:
        """Set the references; 30 of them are used if there are more."""
        self._tests, self._whole = tests, tests.whole
        self._names = [tests.names[place] for place in evenly_spaced(len(tests.names), _MOST_TESTS)]
        self._outcome = cache(self._localized)

    def default(self) -> FirstSize:
        """The size for a map that says nothing."""
        return self._from(first_size(self._whole))

    def default_seconds(self) -> float:
        """Predicted mean time of extraction per query, with the default size."""
        first = first_size(self._whole)
        with threadpool_limits(1):
            rounds = [one for name in self._names for one in self._rounds(name, first)]
        times = sum(share * self._tests.extract_seconds(size) for size, share, _ in rounds)
        return times / len(self._names)

    def best(self) -> FirstSize:
        """The size that costs least.

        A first image smaller than the default one must give poses that are predicted to be about as exact as
        those of the whole image, one at least as large need not.
        """
        usual, whole = self.default(), self._from(self._whole)
        sizes = [size for size in FIRST_SIZES if first_size(self._whole, size) == size < self._whole]
        tried = [self._from(size) for size in sizes]
        exact = [one for one in tried if np.isfinite(one.error) and one.error <= _AS_EXACT * whole.error]
        smaller = [one for one in exact if one.size < usual.size]
        larger = [one for one in tried if one.size > usual.size]
        return min([usual, *smaller, *larger, whole], key=lambda one: one.pixels)

    def _from(self, first: int) -> FirstSize:
        with threadpool_limits(1):  # products on several threads may round differently
            rounds = [list(self._rounds(name, first)) for name in self._names]
        per_query = len(rounds)
        pixels = sum(share * size**2 + _ROUND for one in rounds for size, share, _ in one)
        errors = [one[-1][2] for one in rounds]
        return FirstSize(
            size=first,
            pixels=pixels / per_query,
            error=float(np.median(errors)),
        )

    def _rounds(self, name: str, first: int) -> Iterator[tuple[int, float, float]]:
        """Size, share of the image and predicted error of each round until one suffices."""
        error, is_posed = self._outcome(name, first)
        yield first, 1.0, error
        if error <= ACCURATE or first >= self._whole:
            return
        share = self._tests.share(name) if is_posed else 1.0
        if size := second_size(self._whole, first, share):
            error, _ = self._outcome(name, size)
            yield size, share, error
        if error > ACCURATE:
            yield self._whole, 1.0, self._outcome(name, self._whole)[0]

    def _localized(self, name: str, size: int) -> tuple[float, bool]:
        """Predicted error of a pose that can be sure, infinite without one; whether there is any pose."""
        pose = self._tests.localize(name, size)
        if pose is None or pose.num_inliers < _SURE_INLIERS:
            return np.inf, pose is not None
        return self._tests.predicted_error(pose), True
