"""What every extractor and every matcher takes and gives."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64, Shaped, UInt8

from slimsfm.arrays import Descriptors, GrayImage, Image, IndexPairs


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """The local features of one image; row i of each array describes keypoint i."""

    keypoints: Float32[np.ndarray, "n 2"]
    """Pixels, COLMAP's convention: the centre of the top-left pixel is (0.5, 0.5)."""

    descriptors: Shaped[np.ndarray, "n d"]
    """As the extractor stores them (bytes or floats); `unit_rows` makes them comparable."""

    scores: Float32[np.ndarray, " n"]
    """How sure the detector is of each keypoint; larger is surer."""

    image_size: tuple[int, int]
    """Width and height of the upright image in pixels."""

    frames: Float32[np.ndarray, "n 2"] | None = None
    """Scale in pixels and orientation in radians of each keypoint; None where the detector tells neither."""

    def __len__(self) -> int:
        return len(self.keypoints)

    def __getitem__(self, rows: Int64[np.ndarray, " k"]) -> "Features":
        """The features of these rows, in this order."""
        return Features(
            keypoints=self.keypoints[rows],
            descriptors=self.descriptors[rows],
            scores=self.scores[rows],
            image_size=self.image_size,
            frames=None if self.frames is None else self.frames[rows],
        )


@runtime_checkable
class Extractor(Protocol):
    """Finds and describes keypoints. Equal images give equal features."""

    @property
    def name(self) -> str:
        """The name under which a map remembers its extractor."""
        ...

    @property
    def options(self) -> dict:
        """What `load_extractor` needs to make an equal extractor."""
        ...

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Find features, none where the mask, of the image's size, is 0. There may be no feature at all."""
        ...


@runtime_checkable
class Matcher(Protocol):
    """Matches the features of two images. Equal features give equal matches.

    It is made with one argument, `features`: the name of the extractor whose features it matches.
    """

    def match(self, features1: Features, features2: Features) -> IndexPairs:
        """Match two images; no feature occurs twice. Sorted by the feature of the first."""
        ...


def unit_rows(
    descriptors: Shaped[np.ndarray, "n d"], out: Float32[np.ndarray, "n d"] | None = None
) -> Descriptors:
    """Make descriptors comparable by their dot product: rows of length 1 (a row of zeros stays one).

    Args:
        descriptors: As an extractor stores them.
        out: Where the rows go; new memory if not given.
    """
    rows = np.empty(descriptors.shape, np.float32) if out is None else out
    np.copyto(rows, descriptors, casting="unsafe")
    lengths = np.sqrt(np.einsum("nd,nd->n", rows, rows))
    rows /= np.maximum(lengths, np.float32(1e-12))[:, None]
    return rows


def image_colors(
    image: UInt8[np.ndarray, "h w 3"], keypoints: Float32[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "n 3"]:
    """The RGB of the pixel that each keypoint lies in."""
    limits = np.array(image.shape[1::-1]) - 1
    columns, rows = np.clip(keypoints.astype(np.int64), 0, limits).T
    return image[rows, columns]
