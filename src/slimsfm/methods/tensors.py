"""Conversions shared by learned extractors: images to tensors, network outputs to features."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from slimsfm.arrays import GrayImage, Image
from slimsfm.features.base import Features
from slimsfm.features.brightness import brighten
from slimsfm.methods.keypoints import best_rows
from slimsfm.photos import shrink


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkInput:
    """An image as the input of a network."""

    pixels: Float[Tensor, "1 3 h w"]
    """RGB from 0 to 1."""

    factors: Float32[np.ndarray, "2"]
    """Factors (x, y) from pixels of the input to pixels of the image."""

    image_size: tuple[int, int]
    """Width and height of the image."""


def network_input(image: Image, max_image_size: int, device: torch.device) -> NetworkInput:
    """Shrink an image to a longer side of at most `max_image_size` pixels, and brighten it if it is dark."""
    (height, width), small = image.shape[:2], brighten(shrink(image, max_image_size))
    pixels = torch.from_numpy(np.ascontiguousarray(small)).to(device).permute(2, 0, 1)[None]
    return NetworkInput(
        pixels=pixels.to(torch.float32) / 255,
        factors=np.array([width / small.shape[1], height / small.shape[0]], np.float32),
        image_size=(width, height),
    )


def features_of(
    taken: NetworkInput,
    keypoints: Float[Tensor, "n 2"],
    descriptors: Float[Tensor, "n d"],
    scores: Float[Tensor, " n"],
    mask: GrayImage | None,
    max_features: int,
) -> Features:
    """Convert the output of a network to features of the whole image, by decreasing score.

    Args:
        taken: Input of the network.
        keypoints: Pixels of the input; the center of the top-left pixel is (0, 0).
        descriptors: Rows of unit length; they are stored in half precision.
        scores: Confidence of each keypoint.
        mask: Of the size of the image; keypoints where it is 0 are dropped.
        max_features: Largest number of features.
    """
    pixels = (_numpy(keypoints) + np.float32(0.5)) * taken.factors
    strength = _numpy(scores)
    order = best_rows(pixels, strength, mask, max_features)
    return Features(
        keypoints=pixels[order],
        descriptors=_numpy(descriptors)[order].astype(np.float16),
        scores=strength[order],
        image_size=taken.image_size,
    )


def _numpy(values: Tensor) -> Float32[np.ndarray, "..."]:
    return values.detach().to("cpu", torch.float32).numpy()
