"""Which image size to extract the first features of a query from, found on references that are left out.

Extraction takes time in proportion to the pixels. A shrunken image has the keypoints of the whole one whose
scale is still large enough after shrinking, so a map without photos can tell how many of its references
an image of each size would localize, and how exactly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from slimsfm.localization.extraction import FIRST_SIZES, second_size, usual_first_size
from slimsfm.localization.search import ACCURATE
from slimsfm.pose import PoseEstimate

_MOST_TESTS = 30
_SURE_INLIERS = 12  # of a pose that is sure enough to stop, hardly ever less
_ROUND = 160**2  # pixels whose extraction takes as long as matching and pose of one round
_AS_EXACT = 1.2  # times the error with the whole image, at which a smaller first image is preferred


@dataclass(frozen=True, kw_only=True)
class ImageSizes:
    """The rounds of extraction for a query of the size of a map's photos."""

    sizes: tuple[int, ...]
    """Longer side of the image in each round, in pixels."""

    reached: tuple[float, ...]
    """Predicted share of queries that need each round; all need the first."""

    error: float
    """Median of the predicted corner error of the poses that end the search."""

    @property
    def pixels(self) -> float:
        """Pixels extracted per query on average, and what each round costs besides, in pixels."""
        return sum(share * (size**2 + _ROUND) for size, share in zip(self.sizes, self.reached, strict=True))


class SizeTrials:
    """Tries image sizes on references that are left out."""

    def __init__(
        self,
        whole: int,
        tests: Sequence[str],
        localize: Callable[[str, int], PoseEstimate | None],
        predicted_error: Callable[[PoseEstimate], float],
        extract_seconds: Callable[[int], float],
    ) -> None:
        """Set what is tried.

        Args:
            whole: Longer side of the image from which features are extracted at once.
            tests: The references; 30 of them are used if there are more.
            localize: Localizes one of them by the keypoints that an image with this longer side has.
            predicted_error: Relative corner error of a pose, if its inliers are right.
            extract_seconds: Time of extracting features from an image with this longer side.
        """
        places = np.linspace(0, len(tests) - 1, min(_MOST_TESTS, len(tests))).round().astype(int)
        self._whole, self._tests = whole, [tests[place] for place in places.tolist()]
        self._localize, self._predicted_error = localize, predicted_error
        self._extract_seconds = extract_seconds
        self._errors: dict[int, np.ndarray] = {}

    def default(self) -> ImageSizes:
        """The sizes for a map that says nothing."""
        return self._from(usual_first_size(self._whole))

    def extraction_seconds(self) -> float:
        """Predicted mean time of extraction per query, with the default sizes."""
        usual = self.default()
        times = [self._extract_seconds(size) for size in usual.sizes]
        return sum(share * time for share, time in zip(usual.reached, times, strict=True))

    def best(self) -> ImageSizes:
        """The sizes that cost least.

        A first image smaller than the default one must give poses that are predicted to be about as exact as
        those of the whole image, one at least as large need not.
        """
        usual, whole = self.default(), self._from(self._whole)
        tried = [self._from(size) for size in FIRST_SIZES if size < self._whole]
        smaller = [
            one for one in tried if one.sizes[0] < usual.sizes[0] and one.error <= _AS_EXACT * whole.error
        ]
        larger = [one for one in tried if one.sizes[0] > usual.sizes[0]]
        return min([usual, *smaller, *larger, whole], key=lambda one: one.pixels)

    def _from(self, first: int) -> ImageSizes:
        between = second_size(self._whole, first) if first < self._whole else None
        sizes = tuple(sorted({first, between or first, self._whole}))
        left, ended = np.ones(len(self._tests), bool), np.full(len(self._tests), np.inf)
        reached = []
        for size in sizes:
            reached.append(float(left.mean()))
            errors = self._errors_at(size)
            ends = left & ((errors <= ACCURATE) | (size == sizes[-1]))
            ended[ends] = errors[ends]
            left &= ~ends
        return ImageSizes(sizes=sizes, reached=tuple(reached), error=float(np.median(ended)))

    def _errors_at(self, size: int) -> np.ndarray:
        """Predicted error of each test with an image of a size; infinite if its pose cannot be sure."""
        if size not in self._errors:
            poses = [self._localize(name, size) for name in self._tests]
            enough = [pose if pose and pose.num_inliers >= _SURE_INLIERS else None for pose in poses]
            errors = [np.inf if pose is None else self._predicted_error(pose) for pose in enough]
            self._errors[size] = np.array(errors, np.float64)
        return self._errors[size]
