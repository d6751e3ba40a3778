"""What matching two images without keypoints takes and gives.

Such a matcher lays a grid of cells over each image and finds which cells of two images show the same; then it
looks around a matched cell for where exactly that is.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float16, Float32, UInt8

from slimsfm.arrays import Points2D
from slimsfm.features.methods import importing, resolve

# Of any size, since several are passed around at a time.
Photo = UInt8[np.ndarray, "_ _ 3"]
"""RGB, upright."""

PhotoMask = UInt8[np.ndarray, "_ _"]
"""Gray, upright."""

AnyImage = Photo | PhotoMask
"""RGB or gray, upright."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageMatches:
    """Places of two images that show the same, the surest first."""

    points2D_1: Points2D
    """Pixels of the first image."""

    points2D_2: Points2D
    """For each of them where it is in the second."""

    scores: Float32[np.ndarray, " k"]
    """How sure the matcher is, from 0 to 1."""

    def __len__(self) -> int:
        return len(self.scores)


@runtime_checkable
class EncodedImage(Protocol):
    """What a matcher keeps of an image that it is to match with several others."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        ...

    @property
    def cell_px(self) -> float:
        """Side of a cell in pixels of the image, the longer one where they differ."""
        ...


Encoded = Any
"""An `EncodedImage` of the matcher's own."""


@runtime_checkable
class ImageMatcher(Protocol):
    """Matches images as wholes. Equal images give equal matches; no method depends on what came before."""

    @property
    def name(self) -> str:
        """The name under which a map remembers what matched its images."""
        ...

    @property
    def options(self) -> dict:
        """What an equal matcher is made with."""
        ...

    def encode(self, image: AnyImage, *, cells_only: bool = False) -> EncodedImage:
        """Look at one image, just as far as `match_cells` needs it if `cells_only`."""
        ...

    def match(self, one: Encoded, other: Encoded) -> ImageMatches:
        """Match two images: cells of the first with exact places in the second."""
        ...

    def match_cells(self, one: Encoded, other: Encoded) -> ImageMatches:
        """Match cells of two images; a cell always has the same pixels, and occurs at most once."""
        ...

    def align(self, one: Encoded, other: Encoded, points2D_1: Points2D, points2D_2: Points2D) -> Points2D:
        """Where exactly in the second image places of the first are.

        Args:
            one: The first image.
            other: The second image.
            points2D_1: Pixels of the first.
            points2D_2: For each of them about where it is in the second, to half a cell.
        """
        ...

    def describe(self, one: Encoded, points2D: Points2D) -> Float16[np.ndarray, "n d"]:
        """What places of an image look like, regardless of any other image."""
        ...


# Paths, not classes: naming a matcher must not import its deep-learning stack.
IMAGE_MATCHERS = {
    "loftr": "slimsfm.features.loftr:Loftr",
}
"""The matchers by name: those of `DETECTOR_FREE`."""


def load_image_matcher(name: str, options: dict) -> ImageMatcher:
    """Make the matcher of this name.

    Raises:
        InputError: What it needs is missing.
    """
    with importing(f"extractor {name!r}"):
        return resolve(IMAGE_MATCHERS[name])(**options)
