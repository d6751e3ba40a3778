"""Global descriptors of images from their local ones: VLAD [1], normalized word by word [2].

References:
    [1] Jegou, Douze, Schmid and Perez, Aggregating Local Descriptors into a Compact Image Representation,
        CVPR 2010.
    [2] Arandjelovic and Zisserman, All about VLAD, CVPR 2013.
"""

import warnings

import numpy as np
from jaxtyping import Float32, Int64
from scipy.sparse import csr_array

from slimsfm.arrays import Descriptors

NUM_WORDS = 64
_SAMPLE = 20_000  # descriptors that words are learned from
_ROUNDS = 8  # of k-means


def learn_words(descriptors: Descriptors, seed: int = 0) -> Float32[np.ndarray, "words d"]:
    """Cluster centres of descriptors, by k-means; fewer than 64 where there are fewer descriptors.

    Raises:
        ValueError: There is no descriptor.
    """
    from scipy.cluster.vq import kmeans2  # slow to import, and not needed where the map has its words

    if not len(descriptors):
        raise ValueError("descriptors must have at least one row to learn words from")
    rng = np.random.default_rng(seed)
    if len(descriptors) > _SAMPLE:
        descriptors = descriptors[np.sort(rng.choice(len(descriptors), _SAMPLE, replace=False))]
    count = min(NUM_WORDS, len(descriptors))
    first = descriptors[np.sort(rng.choice(len(descriptors), count, replace=False))]
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # a word without members stays
        words, _ = kmeans2(descriptors, first, iter=_ROUNDS, minit="matrix", missing="warn")
    return np.ascontiguousarray(words, np.float32)


def nearest_word(descriptors: Descriptors, words: Float32[np.ndarray, "words d"]) -> Int64[np.ndarray, " n"]:
    """The row of the word nearest to each descriptor."""
    return np.argmax(descriptors @ words.T - 0.5 * np.einsum("wd,wd->w", words, words), axis=1)


def vlad(descriptors: Descriptors, words: Float32[np.ndarray, "words d"]) -> Float32[np.ndarray, " words*d"]:
    """One row of unit length for all descriptors of an image; zeros where it has none.

    Of each word the differences of its descriptors from it are summed up and made of unit length, so that no
    texture counts more for being repeated. O(n words d).
    """
    count = len(descriptors)
    nearest = nearest_word(descriptors, words)
    order = np.argsort(nearest, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(nearest, minlength=len(words)))])
    members = csr_array((np.ones(count, np.float32), order, starts), shape=(len(words), count))
    sums = members @ descriptors - np.diff(starts).astype(np.float32)[:, None] * words
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.float32(1e-6))
    return sums.ravel() / max(np.linalg.norm(sums), np.float32(1e-6))
