"""Matching by descriptor distance: mutual nearest neighbors that pass Lowe's ratio test."""

import numpy as np
from jaxtyping import Float32, Int64

from slimsfm.arrays import IndexPairs
from slimsfm.features.base import Features, NearestOptions, unit_rows
from slimsfm.features.registry import descriptor_metric_of

_BLOCK = 256  # rows


class Nearest:
    """Matches the features of two images by descriptor distance."""

    def __init__(self, features: str = "sift") -> None:
        self._options = descriptor_metric_of(features)

    def match(self, features1: Features, features2: Features) -> IndexPairs:
        """Match two images. Each feature occurs at most once; pairs are sorted by the first feature."""
        descriptors = unit_rows(features1.descriptors), unit_rows(features2.descriptors)
        return match_nearest(*descriptors, self._options)


def match_nearest(
    descriptors1: Float32[np.ndarray, "n d"],
    descriptors2: Float32[np.ndarray, "m d"],
    options: NearestOptions = NearestOptions(),
) -> Int64[np.ndarray, "k 2"]:
    """Match two sets of descriptors of unit length, as COLMAP does: mutual nearest, ratio test on angles.

    Each row of either set is matched at most once. The ratio test applies to the rows of `descriptors1`.
    Complexity: O(n m d), one matrix product, computed in blocks of rows that stay in the processor's cache.

    Returns:
        Pairs (row of `descriptors1`, row of `descriptors2`), sorted by the first.
    """
    if len(descriptors1) == 0 or len(descriptors2) == 0:
        return np.zeros((0, 2), np.int64)
    nearest, best, second, best_of_column = _nearest_two(descriptors1, descriptors2)
    angles = _angles(best)
    good = (angles <= options.max_ratio * _angles(second)) & (angles <= options.max_distance)
    rows = np.flatnonzero(good & (best >= best_of_column[nearest]))
    _, first = np.unique(nearest[rows], return_index=True)  # of equal descriptors the first is matched
    rows = rows[np.sort(first)]
    return np.stack([rows, nearest[rows]], axis=1)


def _nearest_two(
    descriptors1: Float32[np.ndarray, "n d"], descriptors2: Float32[np.ndarray, "m d"]
) -> tuple[
    Int64[np.ndarray, " n"], Float32[np.ndarray, " n"], Float32[np.ndarray, " n"], Float32[np.ndarray, " m"]
]:
    """Nearest neighbor of each row, its cosine, the second best cosine, and the best of each column."""
    nearest = np.empty(len(descriptors1), np.int64)
    best, second = np.empty((2, len(descriptors1)), np.float32)
    best_of_column = np.full(len(descriptors2), -np.inf, np.float32)
    transposed = np.ascontiguousarray(descriptors2.T)
    memory = np.empty((_BLOCK, len(descriptors2)), np.float32)  # reused: new pages are expensive
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
