"""Local features, and the protocols of extractors and matchers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, Shaped, UInt8

from slimsfm.arrays import Descriptors, GrayImage, Image, IndexPairs


@dataclass(frozen=True, kw_only=True)
class NearestOptions:
    """How descriptors compare: which nearest neighbors count as matches."""

    max_ratio: float = 0.8
    """Largest distance to the nearest neighbor, relative to the distance to the second nearest."""

    max_distance: float = 0.7
    """Largest angle in radians between two matched descriptors."""

    def __post_init__(self) -> None:
        if not 0 < self.max_ratio <= 1:
            raise ValueError(f"max_ratio must be in (0, 1], got {self.max_ratio}")
        if not self.max_distance > 0:
            raise ValueError(f"max_distance must be positive, got {self.max_distance}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """The local features of one image; row i of each array describes keypoint i."""

    keypoints: Float32[np.ndarray, "n 2"]
    """Pixels, COLMAP's convention: the center of the top-left pixel is (0.5, 0.5)."""

    descriptors: Shaped[np.ndarray, "n d"]
    """As the extractor stores them (bytes or floats); `unit_rows` makes them comparable."""

    scores: Float32[np.ndarray, " n"]
    """Confidence of the detector in each keypoint; larger is better."""

    image_size: tuple[int, int]
    """Width and height of the upright image in pixels."""

    frames: Float32[np.ndarray, "n 2"] | None = None
    """Scale in pixels and orientation in radians of each keypoint; None if the detector estimates neither."""

    def __len__(self) -> int:
        return len(self.keypoints)

    def __getitem__(self, rows: Int64[np.ndarray, " k"]) -> "Features":
        """Select features by row, in the given order."""
        return Features(
            keypoints=self.keypoints[rows],
            descriptors=self.descriptors[rows],
            scores=self.scores[rows],
            image_size=self.image_size,
            frames=None if self.frames is None else self.frames[rows],
        )


@runtime_checkable
class Extractor(Protocol):
    """Finds and describes keypoints. Equal images give equal features.

    The class of a plug-in may also have the attributes `descriptor_metric`, a `NearestOptions`, and
    `has_keypoints`.
    """

    @property
    def name(self) -> str:
        """Name of the extractor in a map's `map.json`."""
        ...

    @property
    def options(self) -> dict:
        """Options with which `load_extractor` creates an equal extractor."""
        ...

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Extract features; the mask has the size of the image, and no feature lies where it is 0.

        The result may be empty.
        """
        ...


@runtime_checkable
class Matcher(Protocol):
    """Matches the features of two images. Equal features give equal matches.

    The class takes one argument, `features`: the name of the extractor whose features are matched.
    """

    def match(self, features1: Features, features2: Features) -> IndexPairs:
        """Match two images. Each feature occurs at most once; pairs are sorted by the first feature."""
        ...


@runtime_checkable
class BatchMatcher(Matcher, Protocol):
    """A matcher that matches several pairs of images at once sooner than one after the other."""

    def match_many(self, pairs: Sequence[tuple[Features, Features]]) -> list[IndexPairs]:
        """Match pairs of images; the result for each equals that of `match` up to rounding."""
        ...


def match_many(matcher: Matcher, pairs: Sequence[tuple[Features, Features]]) -> list[IndexPairs]:
    """Match pairs of images at once if the matcher can, else one after the other."""
    if isinstance(matcher, BatchMatcher):
        return matcher.match_many(pairs)
    return [matcher.match(one, other) for one, other in pairs]


def shrink_factor(extractor_options: Mapping, width: int, height: int) -> float:
    """Pixels of an image per pixel in which its features are found; 1 unless its extractor shrinks it.

    Errors of keypoints grow with this factor, so limits in pixels are multiplied by it.

    Args:
        extractor_options: The extractor's `options`; without `max_image_size`, it shrinks nothing.
        width: Width of the image in pixels.
        height: Height of the image in pixels.
    """
    largest = extractor_options.get("max_image_size")
    return max(1.0, max(width, height) / largest) if largest else 1.0


def unit_rows(descriptors: Shaped[np.ndarray, "n d"]) -> Descriptors:
    """Scale descriptors to unit length, so that dot products compare them. Rows of zeros stay zero."""
    rows = np.array(descriptors, np.float32, order="C")
    lengths = np.sqrt(np.einsum("nd,nd->n", rows, rows))
    rows /= np.maximum(lengths, np.float32(1e-12))[:, None]
    return rows


def unmasked(keypoints: Float[np.ndarray, "n 2"], mask: GrayImage | None) -> Bool[np.ndarray, " n"]:
    """Which keypoints lie on pixels of a mask that are not 0; all do if there is no mask."""
    if mask is None:
        return np.ones(len(keypoints), dtype=bool)
    columns, rows = np.clip(keypoints.astype(np.int64), 0, np.array(mask.shape[::-1]) - 1).T
    return mask[rows, columns] > 0


def image_colors(
    image: UInt8[np.ndarray, "h w 3"], keypoints: Float32[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "n 3"]:
    """RGB of the pixel in which each keypoint lies."""
    limits = np.array(image.shape[1::-1]) - 1
    columns, rows = np.clip(keypoints.astype(np.int64), 0, limits).T
    return image[rows, columns]
