"""Features of a query in rounds, from a small version of the image to the whole one.

Most queries are localized by a tenth of their pixels, and extraction takes time in proportion to them. So
features are extracted from a shrunken image first, and from a larger one only if the pose is not sure. All
rounds together have at most four thirds of the pixels of the whole image.
"""

from functools import lru_cache
from math import sqrt
from time import perf_counter
from typing import Literal, NamedTuple

from slimsfm.arrays import GrayImage, Image
from slimsfm.features import Extractor, Features, load_extractor
from slimsfm.mapping.extractor import extractor_of
from slimsfm.mapping.map import Map

ExtractionChoice = Literal["rounds", "whole"]

FIRST_SIZES = 128, 160, 200, 240, 280, 320, 360, 400, 480, 560, 640, 800
"""Longer sides of the first image, in pixels, that `reduce` tries."""

_FIRST = 0.39  # of the longer side: a seventh of the pixels
_LEAST = 128  # pixels: smaller images are extracted at once
_MORE_PIXELS = 1 / 3  # of all rounds before the last, relative to the last
_GROWTH = 1.4  # of the longer side from round to round, at least
_MOST_SIZES = 16  # extractors that are kept


def first_size(whole: int) -> int:
    """Longer side of the first image for a map that says nothing of it; it may be that of the whole image."""
    return max(_LEAST, round(_FIRST * whole))


def image_sizes(whole: int, first: int) -> tuple[int, ...]:
    """Longer sides of the images from which features are extracted in turn, in pixels.

    All images before the last have at most a third of its pixels.

    Args:
        whole: Longer side of the image from which the extractor would extract at once.
        first: Longer side to begin with. If it is not much smaller than the whole image, that is the only
            one.
    """
    if first > whole * sqrt(_MORE_PIXELS):
        return (whole,)
    second = int(sqrt(_MORE_PIXELS * whole**2 - first**2))
    return (first, second, whole) if second >= _GROWTH * first else (first, whole)


class Extracted(NamedTuple):
    """Features of an image, extracted at a size."""

    features: Features
    """In pixels of the image."""

    shrink_factor: float
    """Pixels of the image per pixel in which they were found."""


class SizedExtractor:
    """The extractor of a map, for images of several sizes.

    Attributes:
        whole: The extractor with the image size of the map.
    """

    def __init__(self, map: Map) -> None:
        self.whole = extractor_of(map)
        self._first = map.info.first_image_size
        self._of_size = lru_cache(_MOST_SIZES)(self._with_size)

    @property
    def key(self) -> str:
        """Equal for extractors that extract the same."""
        return repr((self.whole.name, sorted(self.whole.options.items())))

    def sizes(self, image: Image) -> tuple[int, ...]:
        """The longer sides of the rounds for an image; one if the extractor has no image size."""
        longer = max(image.shape[:2])
        largest = self.whole.options.get("max_image_size")
        if largest is None:
            return (longer,)
        whole = min(longer, largest)
        return image_sizes(whole, self._first or first_size(whole))

    def extract(self, image: Image, mask: GrayImage | None, size: int) -> Extracted:
        """Extract the features of an image whose longer side is shrunk to `size` pixels."""
        longer = max(image.shape[:2])
        largest = self.whole.options.get("max_image_size", longer)
        extractor = self.whole if size >= min(longer, largest) else self._of_size(size)
        return Extracted(extractor.extract(image, mask), max(1.0, longer / size))

    def _with_size(self, size: int) -> Extractor:
        return load_extractor(self.whole.name, {**self.whole.options, "max_image_size": size})


class ImageRounds:
    """Features of one image, from coarse to fine; each size is extracted once.

    Attributes:
        image: The image.
        seconds: Wall time of all extractions so far.
    """

    def __init__(self, image: Image, mask: GrayImage | None = None) -> None:
        self.image, self._mask = image, mask
        self._extracted: dict[tuple[str, int], Extracted] = {}
        self.seconds = 0.0

    def at(self, extractor: SizedExtractor, size: int) -> Extracted:
        """The features at a size by an extractor; extracts them unless an equal extractor has done it."""
        key = extractor.key, size
        if key not in self._extracted:
            start = perf_counter()
            self._extracted[key] = extractor.extract(self.image, self._mask, size)
            self.seconds += perf_counter() - start
        return self._extracted[key]
