"""Matching by descriptor distance: mutual nearest neighbours that pass Lowe's ratio test."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from slimsfm.arrays import Descriptors, IndexPairs


@dataclass(frozen=True, kw_only=True)
class NearestOptions:
    """Which nearest neighbours count as matches."""

    max_ratio: float = 0.8
    """Largest distance to the nearest over that to the second nearest."""

    max_distance: float = 0.7
    """Largest angle in radians between two matched descriptors."""

    def __post_init__(self) -> None:
        if not 0 < self.max_ratio <= 1:
            raise ValueError(f"max_ratio must be in (0, 1], got {self.max_ratio}")
        if not self.max_distance > 0:
            raise ValueError(f"max_distance must be positive, got {self.max_distance}")


def match_nearest(
    descriptors1: Float32[np.ndarray, "n d"],
    descriptors2: Float32[np.ndarray, "m d"],
    options: NearestOptions = NearestOptions(),
) -> IndexPairs:
    """Match two sets of descriptors of unit length, as COLMAP does: mutual nearest, ratio test on angles.

    Each row of one set is matched at most once. The ratio test applies on the side of `descriptors1`.
    Complexity: O(n m d), one matrix product.

    Returns:
        Pairs (row of `descriptors1`, row of `descriptors2`), sorted by the first.
    """
    if len(descriptors1) == 0 or len(descriptors2) == 0:
        return np.zeros((0, 2), np.int64)
    similarities = descriptors1 @ descriptors2.T
    nearest2 = similarities.argmax(axis=1)
    rows = np.arange(len(descriptors1))
    mutual = similarities.argmax(axis=0)[nearest2] == rows
    rows, nearest2 = rows[mutual], nearest2[mutual]
    best = _angles(similarities[rows, nearest2])
    similarities[rows, nearest2] = -1
    second = _angles(similarities[rows].max(axis=1)) if len(descriptors2) > 1 else np.full(len(rows), np.inf)
    good = (best <= options.max_ratio * second) & (best <= options.max_distance)
    return np.stack([rows[good], nearest2[good]], axis=1).astype(np.int64)


def _angles(cosines: Descriptors | np.ndarray) -> np.ndarray:
    return np.arccos(np.clip(cosines, -1, 1))
