"""What all learned extractors do with keypoints, without PyTorch."""

import numpy as np
from jaxtyping import Float32, Int64

from slimsfm.arrays import GrayImage
from slimsfm.features.base import unmasked


def check_sizes(max_features: int, max_image_size: int) -> None:
    """Validate the limits of an extractor.

    Raises:
        ValueError: `max_features` is below 1 or `max_image_size` below 32.
    """
    if max_features < 1:
        raise ValueError(f"max_features must be at least 1, got {max_features}")
    if max_image_size < 32:
        raise ValueError(f"max_image_size must be at least 32, got {max_image_size}")


def best_rows(
    keypoints: Float32[np.ndarray, "n 2"],
    scores: Float32[np.ndarray, " n"],
    mask: GrayImage | None,
    max_features: int,
) -> Int64[np.ndarray, " k"]:
    """Rows of the keypoints with the highest scores, by decreasing score.

    Args:
        keypoints: Pixels of the image.
        scores: Confidence of each keypoint.
        mask: Of the size of the image; keypoints where it is 0 are dropped.
        max_features: Largest number of keypoints.
    """
    order = np.argsort(-scores, kind="stable")
    return order[unmasked(keypoints, mask)[order]][:max_features]
