"""Array types with named shapes: the letters n, m, d stand for any size, equal within one signature."""

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

Points2D = Float64[np.ndarray, "n 2"]
"""Pixels in COLMAP's convention: the center of the top-left pixel is (0.5, 0.5)."""

Points3D = Float64[np.ndarray, "n 3"]
"""Points in map units, in the frame that the name of the variable says."""

Descriptors = Float32[np.ndarray, "n d"]
"""Rows of unit length."""

Mask = Bool[np.ndarray, " n"]

Image = UInt8[np.ndarray, "height width 3"]
"""RGB, upright."""

GrayImage = UInt8[np.ndarray, "height width"]

Ids = Int64[np.ndarray, " n"]

IndexPairs = Int64[np.ndarray, "n 2"]
"""Row (i, j) matches item i of the first set with item j of the second."""


def evenly_spaced(count: int, most: int) -> Ids:
    """At most `most` of `count` rows, ascending and evenly spaced, with the first and the last one."""
    return np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64)
