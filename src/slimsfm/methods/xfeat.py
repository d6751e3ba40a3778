"""XFeat [1] keypoints and descriptors, by PyTorch or, where it is not installed, by onnxruntime alone.

The network gives maps: a score of each pixel, and a reliability and a descriptor of each cell of 8 x 8
pixels. What follows is the same for both, and gives the numbers of the authors' code: keypoints are the local
maxima of the scores, their own score is multiplied by the reliability of the place, and descriptors are
interpolated between cells.

As the authors do it, both sides of an image are shrunk to multiples of 32. Unlike them, keypoints are scaled
back about the corner of the image and not about the center of its top-left pixel, so they are right by up to
half a pixel more if the sides are no such multiples.

References:
    [1] Potje, Cadar, Araujo, Martins and Nascimento, XFeat: Accelerated Features for Lightweight Image
        Matching, CVPR 2024.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib import import_module
from types import ModuleType
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Int64
from scipy.sparse import csr_array

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features, unit_rows
from slimsfm.features.registry import importing
from slimsfm.methods.keypoints import best_rows, check_sizes
from slimsfm.networks.onnx_files import ArrayRun, onnx_network
from slimsfm.photos import shrink

_STEP = 32  # pixels: the sides of the network's input must be multiples of it
_NEIGHBORHOOD = np.ones((5, 5), np.uint8)  # a keypoint has the highest score within two pixels
_CUBIC = -0.75  # the sharpness of cubic interpolation in PyTorch

Pixels = Int64[np.ndarray, "n 2"]


class CellMaps(NamedTuple):
    """What the network sees in an image."""

    scores: Float32[np.ndarray, "height width"]
    """Probability of each pixel to be the keypoint of its cell."""

    reliability: Float32[np.ndarray, "h w"]
    """How reliably each cell is matched, from 0 to 1."""

    descriptors: Float32[np.ndarray, "h w 64"]
    """Of each cell, of unit length."""


@dataclass(frozen=True, kw_only=True)
class XFeat:
    """Extracts XFeat features."""

    max_features: int = 2048
    """Largest number of keypoints; those with the highest scores are kept."""

    max_image_size: int = 1024
    """Shrink larger images so that their longer side has this many pixels."""

    threshold: float = 0.05
    """Least probability of a keypoint."""

    def __post_init__(self) -> None:
        check_sizes(self.max_features, self.max_image_size)
        if not 0 < self.threshold < 1:
            raise ValueError(f"threshold must be between 0 and 1, got {self.threshold}")
        if onnx_network("xfeat") is None:  # what is missing is said before any work
            _pytorch()

    @property
    def name(self) -> str:
        """Name of the extractor in a map's `map.json`."""
        return "xfeat"

    @property
    def options(self) -> dict:
        """Options with which `load_extractor` creates an equal extractor."""
        return asdict(self)

    @cached_property
    def network(self) -> ArrayRun:
        """The network in PyTorch."""
        return _pytorch().load_maps()

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:
        """Extract features; the mask has the size of the image, and no feature lies where it is 0."""
        (height, width), gray = image.shape[:2], _network_input(shrink(image, self.max_image_size))
        maps = CellMaps(*(one[0] for one in (onnx_network("xfeat") or self.network)(gray[None, None])))
        pixels = find_keypoints(maps.scores, self.threshold)
        scores = score_keypoints(maps, pixels)
        factors = np.array([width / gray.shape[1], height / gray.shape[0]], np.float32)
        keypoints = (pixels + np.float32(0.5)).astype(np.float32) * factors
        rows = best_rows(keypoints, scores, mask, self.max_features)
        return Features(
            keypoints=keypoints[rows],
            descriptors=describe_keypoints(maps, pixels[rows]).astype(np.float16),
            scores=scores[rows],
            image_size=(width, height),
        )


def _pytorch() -> ModuleType:
    with importing("extractor 'xfeat'"):
        return import_module("slimsfm.methods.xfeat_network")


def _network_input(image: Image) -> Float32[np.ndarray, "h w"]:
    """Gray values from 0 to 1, the mean of the colors, interpolated to sides that are multiples of 32."""
    gray = cv2.transform(image.astype(np.float32), np.full((1, 3), 1 / (3 * 255)))
    height, width = (max(_STEP, side // _STEP * _STEP) for side in image.shape[:2])
    return np.asarray(cv2.resize(gray, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def find_keypoints(scores: Float32[np.ndarray, "height width"], threshold: float) -> Pixels:
    """Columns and rows of local maxima of the score above a threshold, row by row.

    The first pixel and the last row and column are left out: the authors' code reads their scores beyond the
    border, or drops them.
    """
    is_best = (scores == cv2.dilate(scores, _NEIGHBORHOOD)) & (scores > threshold)
    is_best[-1], is_best[:, -1], is_best[0, 0] = False, False, False
    return np.stack(np.nonzero(is_best)[::-1], axis=1)


def score_keypoints(maps: CellMaps, pixels: Pixels) -> Float32[np.ndarray, " n"]:
    """The score of each pixel times the reliability of its place."""
    columns, rows = pixels.T
    reliability = _sampling(maps, pixels, _linear) @ maps.reliability.ravel()
    return maps.scores[rows, columns] * reliability


def describe_keypoints(maps: CellMaps, pixels: Pixels) -> Float32[np.ndarray, "n 64"]:
    """Interpolate descriptors of unit length at pixels."""
    cells = maps.descriptors.reshape(-1, maps.descriptors.shape[-1])
    return unit_rows(_sampling(maps, pixels, _cubic) @ cells)


class _Taps(NamedTuple):
    """Cells along one axis from which places are interpolated."""

    indices: Int64[np.ndarray, "n taps"]
    weights: Float32[np.ndarray, "n taps"]


def _linear(places: Float32[np.ndarray, " n"]) -> _Taps:
    first = np.floor(places)
    after = places - first
    return _Taps(first.astype(np.int64)[:, None] + np.arange(2), np.stack([1 - after, after], axis=1))


def _cubic(places: Float32[np.ndarray, " n"]) -> _Taps:
    first = np.floor(places)
    after = places - first
    far, near = np.stack([1 + after, 2 - after], axis=1), np.stack([after, 1 - after], axis=1)
    outer = _CUBIC * (((far - 5) * far + 8) * far - 4)
    inner = ((_CUBIC + 2) * near - (_CUBIC + 3)) * near * near + 1
    weights = np.stack([outer[:, 0], inner[:, 0], inner[:, 1], outer[:, 1]], axis=1)
    return _Taps(first.astype(np.int64)[:, None] + np.arange(-1, 3), weights)


def _sampling(maps: CellMaps, pixels: Pixels, taps_at: Callable[..., _Taps]) -> csr_array:
    """A matrix that interpolates a map, a row per cell, at pixels; zeros lie beyond the border.

    The first pixel is at the outer edge of the first cell and the last pixel at that of the last cell, which
    is what the network was trained with.
    """
    (height, width), shape = maps.scores.shape, maps.reliability.shape
    indices, weights = [], []
    for pixel, size, cells in zip(pixels.T, (width, height), shape[::-1], strict=True):
        places = pixel.astype(np.float32) * np.float32(cells / (size - 1)) - np.float32(0.5)
        taps = taps_at(places)
        is_inside = (taps.indices >= 0) & (taps.indices < cells)
        indices.append(np.clip(taps.indices, 0, cells - 1))
        weights.append(np.where(is_inside, taps.weights, np.float32(0)))
    index = indices[1][:, :, None] * shape[1] + indices[0][:, None]
    weight = weights[1][:, :, None] * weights[0][:, None]
    starts = np.arange(len(pixels) + 1) * (index.shape[1] * index.shape[2])
    return csr_array((weight.ravel(), index.ravel(), starts), shape=(len(pixels), shape[0] * shape[1]))
