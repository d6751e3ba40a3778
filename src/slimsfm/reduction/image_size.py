"""Which image size to extract the first features of a query from, found on references that are left out.

Extraction takes time in proportion to the pixels. A shrunken image has the keypoints of the whole one whose
scale is still large enough after shrinking, so a map without photos can tell how many of its references
an image of each size would localize, and how exactly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from slimsfm.localization.extraction import FIRST_SIZES, first_size, image_sizes
from slimsfm.localization.matching import match_target
from slimsfm.localization.search import ACCURATE
from slimsfm.localization.strategy import Target, unite
from slimsfm.mapping.map import Map
from slimsfm.selection.usable_points import LeftOut

SMALLEST_SCALE_PX = 1.0
"""Scale of the smallest keypoints that SIFT finds."""

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
