"""Stretch dark images before features are sought: detectors' thresholds of contrast are absolute."""

import numpy as np
from jaxtyping import UInt8

_DARK, _WHITE = 64, 255  # gray levels
_DARKER = 99.0  # percent of an image's values that are darker in a dark image; the rest may be a lamp
_SAMPLED = 4  # every n-th pixel of both directions is looked at


def brighten(image: UInt8[np.ndarray, "_ _ *channels"]) -> UInt8[np.ndarray, "_ _ *channels"]:
    """Multiply an image that uses less than a quarter of the gray levels, so that it uses all of them.

    Other images are returned as they are. A factor does not change descriptors, but keypoints of low contrast
    are not found.
    """
    brightest = int(np.percentile(image[::_SAMPLED, ::_SAMPLED], _DARKER, method="lower"))
    if not 0 < brightest < _DARK:
        return image
    levels = np.arange(_WHITE + 1) * (_WHITE / brightest)
    return np.clip(np.round(levels), 0, _WHITE).astype(np.uint8)[image]
