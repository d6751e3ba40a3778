"""Matching by descriptor distance: mutual nearest neighbours that pass Lowe's ratio test."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from slimsfm.arrays import IndexPairs
from slimsfm.features.base import Features, unit_rows

_BLOCK = 256  # rows


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


SCALES = {
    "sift": NearestOptions(),
    "aliked": NearestOptions(max_ratio=0.95, max_distance=0.9),
    "disk": NearestOptions(max_ratio=0.95, max_distance=0.9),
    "superpoint": NearestOptions(max_ratio=0.95, max_distance=0.8),
}
"""Which neighbours match, by extractor: descriptors of different methods lie apart at different angles."""


def nearest_for(extractor: str) -> NearestOptions:
    """Which neighbours match among the descriptors of an extractor."""
    return SCALES.get(extractor, NearestOptions())


class Nearest:
    """Matches the features of two images by `match_nearest`."""

    def __init__(self, features: str = "sift") -> None:
        self._options = nearest_for(features)

    def match(self, features1: Features, features2: Features) -> IndexPairs:
        """Match two images; no feature occurs twice. Sorted by the feature of the first."""
        descriptors = unit_rows(features1.descriptors), unit_rows(features2.descriptors)
        return match_nearest(*descriptors, self._options)


def match_nearest(
    descriptors1: Float32[np.ndarray, "n d"],
    descriptors2: Float32[np.ndarray, "m d"],
    options: NearestOptions = NearestOptions(),
) -> Int64[np.ndarray, "k 2"]:
    """Match two sets of descriptors of unit length, as COLMAP does: mutual nearest, ratio test on angles.

    Each row of either set is matched at most once. The ratio test applies on the side of `descriptors1`.
    Complexity: O(n m d), one matrix product, taken in blocks of rows that stay in the processor's cache.

    Returns:
        Pairs (row of `descriptors1`, row of `descriptors2`), sorted by the first.
    """
    if len(descriptors1) == 0 or len(descriptors2) == 0:
        return np.zeros((0, 2), np.int64)
    nearest, best, second, best_of_column = _nearest_two(descriptors1, descriptors2)
    angles = _angles(best)
    good = (angles <= options.max_ratio * _angles(second)) & (angles <= options.max_distance)
    rows = np.flatnonzero(good & (best >= best_of_column[nearest]))
    _, first = np.unique(nearest[rows], return_index=True)  # equal descriptors: the first takes the match
    rows = rows[np.sort(first)]
    return np.stack([rows, nearest[rows]], axis=1)


def _nearest_two(
    descriptors1: Float32[np.ndarray, "n d"], descriptors2: Float32[np.ndarray, "m d"]
) -> tuple[
    Int64[np.ndarray, " n"], Float32[np.ndarray, " n"], Float32[np.ndarray, " n"], Float32[np.ndarray, " m"]
]:
    """Each row's nearest of the other set, its cosine, that of the second nearest, and each column's best."""
    nearest = np.empty(len(descriptors1), np.int64)
    best, second = np.empty((2, len(descriptors1)), np.float32)
    best_of_column = np.full(len(descriptors2), -np.inf, np.float32)
    transposed = np.ascontiguousarray(descriptors2.T)
    memory = np.empty((_BLOCK, len(descriptors2)), np.float32)  # one for all: fresh pages are dear
    for start in range(0, len(descriptors1), _BLOCK):
        block = slice(start, start + _BLOCK)
        rows = np.arange(len(descriptors1[block]))
        cosines = np.matmul(descriptors1[block], transposed, out=memory[: len(rows)])
        nearest[block] = cosines.argmax(axis=1)
        best[block] = cosines[rows, nearest[block]]
        np.maximum(best_of_column, cosines.max(axis=0), out=best_of_column)
        cosines[rows, nearest[block]] = -1
        second[block] = cosines.max(axis=1)
    return nearest, best, second, best_of_column


def _angles(cosines: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    return np.arccos(np.clip(cosines, -1, 1))
