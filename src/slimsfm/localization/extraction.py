"""The extractor of a map, for shrunken images and parts of images, and which sizes these have."""

from dataclasses import replace
from math import ceil, sqrt
from typing import NamedTuple

import numpy as np

from slimsfm.arrays import GrayImage, Image, Points2D
from slimsfm.features import Features, shrink_factor, unmasked
from slimsfm.mapping.extractor import extractor_of
from slimsfm.mapping.map import Map
from slimsfm.photos import shrink

FIRST_SIZES = 128, 160, 200, 240, 280, 320, 360, 400, 480, 560, 640, 800
"""Longer sides of the first image, in pixels, that `reduce` tries."""

SMALLEST_SCALE_PX = 0.9
"""Scale of the smallest keypoints that SIFT finds."""

_FIRST = 0.36  # of the longer side: an eighth of the pixels
_LEAST = 128  # pixels: smaller images are extracted at once
_MORE_PIXELS = 1 / 3  # of all rounds before the last, relative to the last
_GROWTH = 1.4  # of the longer side from round to round, at least
_MARGIN = 0.1  # around the part where points should be, relative to its sides
_LEAST_MARGIN = 0.02  # of the longer side of the image
_LEAST_SIDE = 32  # pixels of the shorter side: networks need some


def first_size(whole: int, wanted: int | None = None) -> int:
    """Longer side of the first image, in pixels; that of the whole image if it would not be much smaller.

    Args:
        whole: Longer side of the whole image.
        wanted: What the map says; None if it says nothing.
    """
    first = wanted or max(_LEAST, round(_FIRST * whole))
    return first if first**2 <= _MORE_PIXELS * whole**2 else whole


def second_size(whole: int, first: int, share: float = 1.0) -> int | None:
    """Longer side of the second image, in pixels; None if it would not be much larger than the first one.

    Args:
        whole: Longer side of the whole image.
        first: Longer side of the first image.
        share: Share of the image that features are extracted from.
    """
    left = max(_MORE_PIXELS - (first / whole) ** 2, 0.0)
    size = min(whole, int(whole * sqrt(left / share)))
    return size if size >= _GROWTH * first else None


class Window(NamedTuple):
    """A part of an image, in pixels."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def area(self) -> int:
        """Number of pixels."""
        return (self.right - self.left) * (self.bottom - self.top)

    @classmethod
    def around(cls, pixels: Points2D, width: int, height: int) -> "Window | None":
        """The part of an image that shows some of these pixels and a margin; None if it shows none."""
        size = np.array([width, height])
        inside = pixels[np.all((pixels >= 0) & (pixels < size), axis=1)]
        if not len(inside):
            return None
        low, high = inside.min(axis=0), inside.max(axis=0)
        margin = _MARGIN * (high - low) + _LEAST_MARGIN * size.max()
        margin = np.maximum(margin, (_LEAST_SIDE - (high - low)) / 2)
        (left, top), (right, bottom) = np.maximum(low - margin, 0), np.minimum(high + margin, size)
        return cls(int(left), int(top), ceil(right), ceil(bottom))


class Extracted(NamedTuple):
    """Features of an image or a part of it, extracted at a size."""

    features: Features
    """In pixels of the image."""

    shrink_factor: float
    """Pixels of the image per pixel in which they were found."""


class SizedExtractor:
    """The extractor of a map, for shrunken images and parts of them.

    Attributes:
        whole: The extractor with the image size of the map.
    """

    def __init__(self, map: Map) -> None:
        self.whole = extractor_of(map)
        self._first = map.info.first_image_size

    @property
    def key(self) -> str:
        """Equal for extractors that extract the same."""
        return repr((self.whole.name, sorted(self.whole.options.items())))

    def whole_size(self, width: int, height: int) -> int:
        """Longer side of the image from which all features are extracted at once."""
        longer = max(width, height)
        return min(longer, self.whole.options.get("max_image_size") or longer)

    def first_size(self, width: int, height: int) -> int:
        """Longer side of the first image; that of the whole one if no smaller image is of use."""
        whole = self.whole_size(width, height)
        first = first_size(whole, self._first)
        is_thin = first * min(width, height) < _LEAST_SIDE * max(width, height)
        return whole if is_thin or "max_image_size" not in self.whole.options else first

    def extract(
        self, image: Image, mask: GrayImage | None, size: int, window: Window | None = None
    ) -> Extracted:
        """Extract features of an image whose longer side is shrunk to `size` pixels, or of a part of it."""
        height, width = image.shape[:2]
        if window is None and size >= self.whole_size(width, height):
            return Extracted(self.whole.extract(image, mask), max(1.0, max(width, height) / size))
        left, top, right, bottom = window or Window(0, 0, width, height)
        part = np.ascontiguousarray(image[top:bottom, left:right])
        small = shrink(part, max(1, round(max(part.shape) * size / max(width, height))))
        small_mask = None
        if mask is not None:
            small_mask = shrink(np.ascontiguousarray(mask[top:bottom, left:right]), max(small.shape[:2]))
        found = self.whole.extract(small, small_mask)
        factors = np.array(part.shape[1::-1]) / small.shape[1::-1]
        moved = replace(
            found,
            keypoints=(found.keypoints * factors + (left, top)).astype(np.float32),
            image_size=(width, height),
            frames=None if found.frames is None else found.frames * np.array([factors.max(), 1], np.float32),
        )
        moved = moved[np.flatnonzero(unmasked(moved.keypoints, mask))]
        return Extracted(moved, factors.max() * shrink_factor(self.whole.options, *small.shape[1::-1]))
