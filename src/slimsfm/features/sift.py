"""SIFT [1] with RootSIFT descriptors [2], interchangeable with COLMAP's.

With precise upscaling, OpenCV finds COLMAP's keypoints to 0.001 px (median) in a fifth of the time, and the
descriptors differ only by the rounding to bytes. So features from a COLMAP database and from this extractor
may be mixed.

References:
    [1] Lowe, Distinctive Image Features from Scale-Invariant Keypoints, IJCV 2004.
    [2] Arandjelovic and Zisserman, Three Things Everyone Should Know to Improve Object Retrieval, CVPR 2012.
"""

from dataclasses import asdict, dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features, unmasked
from slimsfm.features.brightness import brighten
from slimsfm.photos import shrink

_MOST_FEATURES = 1_000_000


@dataclass(frozen=True, kw_only=True)
class Sift:
    """Extracts SIFT features; dark images are brightened first."""

    max_features: int = 4096
    """Largest number of keypoints; those with the strongest contrast are kept."""

    max_image_size: int = 1600
    """Shrink larger images so that their longer side has this many pixels."""

    contrast_threshold: float = 0.02
    """Least contrast of a keypoint; 0.02 at three scales per octave equals COLMAP's 0.0067 per scale."""

    def __post_init__(self) -> None:
        if self.max_features < 1:
            raise ValueError(f"max_features must be at least 1, got {self.max_features}")
        if self.max_features > _MOST_FEATURES:
            raise ValueError(f"max_features must be at most {_MOST_FEATURES}, got {self.max_features}")
        if self.max_image_size < 16:
            raise ValueError(f"max_image_size must be at least 16, got {self.max_image_size}")
        if not self.contrast_threshold > 0:
            raise ValueError(f"contrast_threshold must be positive, got {self.contrast_threshold}")

    @property
    def name(self) -> str:
        """Name of the extractor in a map's `map.json`."""
        return "sift"

    @property
    def options(self) -> dict:
        """Options with which `load_extractor` creates an equal extractor."""
        return asdict(self)

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Extract features; the mask has the size of the image, and no feature lies where it is 0."""
        height, width = image.shape[:2]
        scale = min(1.0, self.max_image_size / max(height, width))
        gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        gray = brighten(shrink(gray, self.max_image_size))
        small_mask = None if mask is None else shrink(mask, self.max_image_size)
        # OpenCV counts features before it applies the mask; with one, those to keep are chosen below.
        most = self.max_features if mask is None else 0
        detector = cv2.SIFT.create(
            most, contrastThreshold=self.contrast_threshold, enable_precise_upscale=True
        )
        found, descriptors = detector.detectAndCompute(gray, small_mask)
        if descriptors is None:
            descriptors = np.zeros((0, 128), np.float32)
        pixels = np.array([keypoint.pt for keypoint in found], np.float32).reshape(-1, 2) + np.float32(0.5)
        factors = np.array([width / gray.shape[1], height / gray.shape[0]], np.float32)
        scores = np.array([keypoint.response for keypoint in found], np.float32)
        frames = np.array([(keypoint.size, keypoint.angle) for keypoint in found], np.float32).reshape(-1, 2)
        # OpenCV's size is a diameter, its angle in degrees.
        frames *= np.array([0.5 / scale, np.pi / 180], np.float32)
        keypoints, order = pixels * factors, np.argsort(-scores, kind="stable")
        # OpenCV may return a few more than requested if responses tie.
        order = order[unmasked(keypoints, mask)[order]][: self.max_features]
        return Features(
            keypoints=keypoints[order],
            descriptors=root_sift(descriptors)[order],
            scores=scores[order],
            image_size=(width, height),
            frames=frames[order],
        )


def root_sift(descriptors: Float32[np.ndarray, "n 128"]) -> UInt8[np.ndarray, "n 128"]:
    """Apply the Hellinger kernel to descriptors, and store them as bytes, times 512, as COLMAP does."""
    sums = np.maximum(np.abs(descriptors).sum(axis=1, keepdims=True), 1e-12)
    return np.clip(np.round(512 * np.sqrt(descriptors / sums)), 0, 255).astype(np.uint8)
