"""Mutual nearest neighbors that pass the ratio test, and global descriptors (VLAD)."""

import warnings
from threading import local

import numpy as np
from jaxtyping import Float32, Int64
from scipy.sparse import csr_array

from slimsfm.arrays import Descriptors, IndexPairs
from slimsfm.features.base import Features, NearestOptions, unit_rows
from slimsfm.features.registry import descriptor_metric_of

_BLOCK = 256  # rows
_MOST_REUSED = 4_000_000  # numbers in memory that is kept


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
    *,
    firsts: Int64[np.ndarray, " _"] | None = None,
) -> Int64[np.ndarray, "k 2"]:
    """Match two sets of descriptors of unit length, as COLMAP does: mutual nearest, ratio test on angles.

    Each row of either set is matched at most once. The ratio test applies to the rows of `descriptors1`.
    Complexity: O(n m d), one matrix product, computed in blocks of rows that stay in the processor's cache.

    Args:
        descriptors1: The first set.
        descriptors2: The second set.
        options: How descriptors compare.
        firsts: Where groups of rows of `descriptors2` start, if several rows describe the same thing. It is
            matched at most once, by the most similar of them, and only other groups are its rivals.

    Returns:
        Pairs (row of `descriptors1`, row of `descriptors2`, the first of its group), sorted by the first.
    """
    if len(descriptors1) == 0 or len(descriptors2) == 0:
        return np.zeros((0, 2), np.int64)
    count = len(descriptors2)
    layers = _layers(np.arange(count) if firsts is None else firsts, count)
    if len(layers) > 1:
        descriptors2 = descriptors2[np.concatenate(layers)]
    nearest, best, second, best_of_column = _nearest_two(
        descriptors1, descriptors2, [len(one) for one in layers]
    )
    angles = _angles(best)
    good = (angles <= options.max_ratio * _angles(second)) & (angles <= options.max_distance)
    rows = np.flatnonzero(good & (best >= best_of_column[nearest]))
    _, first = np.unique(nearest[rows], return_index=True)  # of equal descriptors the first is matched
    rows = rows[np.sort(first)]
    return np.stack([rows, layers[0][nearest[rows]]], axis=1)


def _layers(firsts: Int64[np.ndarray, " groups"], num_rows: int) -> list[Int64[np.ndarray, " _"]]:
    """The first row of each group, the second row of each that has two, and so on; largest groups first."""
    counts = np.diff(firsts, append=num_rows)
    if len(firsts) < num_rows:
        order = np.argsort(-counts, kind="stable")
        firsts, counts = firsts[order], counts[order]
    return [firsts[counts > place] + place for place in range(counts.max())]


def _nearest_two(
    descriptors1: Float32[np.ndarray, "n d"], descriptors2: Float32[np.ndarray, "m d"], sizes: list[int]
) -> tuple[
    Int64[np.ndarray, " n"], Float32[np.ndarray, " n"], Float32[np.ndarray, " n"], Float32[np.ndarray, " _"]
]:
    """Nearest neighbor of each row, its cosine, the second best cosine, and the best of each column.

    Row i of each of the layers of `descriptors2`, whose sizes are given, belongs to the same column.
    """
    nearest = np.empty(len(descriptors1), np.int64)
    best, second = np.empty((2, len(descriptors1)), np.float32)
    best_of_column = np.full(sizes[0], -np.inf, np.float32)
    transposed = descriptors2.T
    if len(descriptors1) > _BLOCK:  # for one block the copy takes longer than the product
        transposed = np.ascontiguousarray(transposed)
    memory = _memory(_BLOCK, len(descriptors2))
    for start in range(0, len(descriptors1), _BLOCK):
        block = slice(start, start + _BLOCK)
        rows = np.arange(len(descriptors1[block]))
        cosines = np.matmul(descriptors1[block], transposed, out=memory[: len(rows)])
        cosines = _best_of_layers(cosines, sizes)
        nearest[block] = cosines.argmax(axis=1)
        best[block] = cosines[rows, nearest[block]]
        np.maximum(best_of_column, cosines.max(axis=0), out=best_of_column)
        cosines[rows, nearest[block]] = -1
        second[block] = cosines.max(axis=1)
    return nearest, best, second, best_of_column


def _best_of_layers(cosines: Float32[np.ndarray, "n m"], sizes: list[int]) -> Float32[np.ndarray, "n _"]:
    """The best cosine of each column over its layers, in the memory of the first."""
    start = sizes[0]
    for size in sizes[1:]:
        best = cosines[:, :size]
        np.maximum(best, cosines[:, start : start + size], out=best)
        start += size
    return cosines[:, : sizes[0]]


_REUSED = local()


def _memory(rows: int, columns: int) -> Float32[np.ndarray, "rows columns"]:
    """Memory of this thread that is used again and again: new pages are expensive."""
    size = rows * columns
    if size > _MOST_REUSED:
        return np.empty((rows, columns), np.float32)
    if getattr(_REUSED, "memory", np.empty(0)).size < size:
        _REUSED.memory = np.empty(size, np.float32)
    return _REUSED.memory[:size].reshape(rows, columns)


def _angles(cosines: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    return np.arccos(np.clip(cosines, -1, 1))


NUM_WORDS = 64
_SAMPLE = 20_000  # descriptors from which words are learned
_ROUNDS = 8  # of k-means


def learn_words(descriptors: Descriptors, seed: int = 0) -> Float32[np.ndarray, "words d"]:
    """Cluster descriptors into 64 words by k-means, or fewer if there are fewer descriptors.

    Raises:
        ValueError: `descriptors` is empty.
    """
    from scipy.cluster.vq import kmeans2  # slow to import, and only needed here

    if not len(descriptors):
        raise ValueError("descriptors must have at least one row to learn words from")
    rng = np.random.default_rng(seed)
    if len(descriptors) > _SAMPLE:
        descriptors = descriptors[np.sort(rng.choice(len(descriptors), _SAMPLE, replace=False))]
    count = min(NUM_WORDS, len(descriptors))
    first = descriptors[np.sort(rng.choice(len(descriptors), count, replace=False))]
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # an empty word keeps its position
        words, _ = kmeans2(descriptors, first, iter=_ROUNDS, minit="matrix", missing="warn")
    return np.ascontiguousarray(words, np.float32)


def nearest_word(descriptors: Descriptors, words: Float32[np.ndarray, "words d"]) -> Int64[np.ndarray, " n"]:
    """Row of the nearest word of each descriptor."""
    return np.argmax(descriptors @ words.T - 0.5 * np.einsum("wd,wd->w", words, words), axis=1)


def vlad(descriptors: Descriptors, words: Float32[np.ndarray, "words d"]) -> Float32[np.ndarray, " words*d"]:
    """Aggregate the descriptors of an image into one vector of unit length; zeros if there are none.

    Per word, the differences of its descriptors from it are summed and scaled to unit length, so that
    repeated texture does not count more. O(n words d).
    """
    count = len(descriptors)
    nearest = nearest_word(descriptors, words)
    order = np.argsort(nearest, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(nearest, minlength=len(words)))])
    members = csr_array((np.ones(count, np.float32), order, starts), shape=(len(words), count))
    sums = members @ descriptors - np.diff(starts).astype(np.float32)[:, None] * words
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.float32(1e-6))
    return sums.ravel() / max(np.linalg.norm(sums), np.float32(1e-6))
