"""Protocols and data types of matching two images without keypoints.

A matcher divides each image into a grid of cells and matches the cells of two images; then it refines each
match within the surroundings of its cell.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float16, Float32, UInt8

from slimsfm.arrays import Points2D

# Without named sizes, because one call may take several images of different sizes.
Photo = UInt8[np.ndarray, "_ _ 3"]
"""RGB, upright."""

PhotoMask = UInt8[np.ndarray, "_ _"]
"""Gray, upright."""

AnyImage = Photo | PhotoMask
"""RGB or gray, upright."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageMatches:
    """Matching pixels of two images, by decreasing score."""

    points2D_1: Points2D
    """Pixels of the first image."""

    points2D_2: Points2D
    """Matching pixels of the second image, row by row."""

    scores: Float32[np.ndarray, " k"]
    """Confidence of each match, from 0 to 1."""

    def __len__(self) -> int:
        return len(self.scores)


@runtime_checkable
class EncodedImage(Protocol):
    """The result of encoding one image, to be matched with several others."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        ...

    @property
    def cell_px(self) -> float:
        """Side of a cell in pixels of the image; the longer one if they differ."""
        ...


Encoded = Any
"""An `EncodedImage` made by the same matcher."""


@runtime_checkable
class ImageMatcher(Protocol):
    """Matches images as a whole. Equal images give equal matches; calls are independent of each other."""

    @property
    def name(self) -> str:
        """Name of the extractor in the map's `map.json`."""
        ...

    @property
    def options(self) -> dict:
        """Keyword arguments that create an equal matcher."""
        ...

    def encode(self, image: AnyImage, *, cells_only: bool = False) -> EncodedImage:
        """Encode one image; with `cells_only`, only as far as `match_cells` needs."""
        ...

    def match(self, one: Encoded, other: Encoded) -> ImageMatches:
        """Match cells of the first image with refined pixels of the second."""
        ...

    def match_cells(self, one: Encoded, other: Encoded) -> ImageMatches:
        """Match cells of two images; a cell always has the same pixels and occurs at most once."""
        ...

    def align(self, one: Encoded, other: Encoded, points2D_1: Points2D, points2D_2: Points2D) -> Points2D:
        """Refine pixels of the second image so that they match pixels of the first.

        Args:
            one: The first image.
            other: The second image.
            points2D_1: Pixels of the first image.
            points2D_2: Approximate matches in the second image, within half a cell.
        """
        ...

    def describe(self, one: Encoded, points2D: Points2D) -> Float16[np.ndarray, "n d"]:
        """Describe pixels of one image, independently of any other image."""
        ...
