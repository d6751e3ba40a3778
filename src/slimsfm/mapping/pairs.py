"""Choose pairs of images to match."""

import re
from collections.abc import Iterable, Mapping
from itertools import combinations
from typing import Literal

import numpy as np
from jaxtyping import Float32, Int64

from slimsfm.features import Features, unit_rows
from slimsfm.features.nearest import learn_words, vlad

Pairs = list[tuple[str, str]]
"""Pairs of image names: each pair is sorted, and so is the list, without duplicates."""

Matches = Mapping[tuple[str, str], Int64[np.ndarray, "_ 2"]]
"""Pairs (row of the first image's keypoints, row of the second's), by pair of image names."""

PairChoice = Literal["auto", "exhaustive", "sequential", "similar"]

_MOST_EXHAUSTIVE = 200  # images up to which "auto" tries all pairs
_MOST_SURE = 60  # images up to which "auto" matches all of them
_WORD_SAMPLES = 50_000  # descriptors that the vocabulary is learned from


def choose_pairs(features: Mapping[str, Features], choice: PairChoice, *, seed: int) -> Pairs:
    """Choose the pairs of images to match; `BuildOptions.pairs` says what each choice means."""
    names = sorted(features)
    if choice == "exhaustive" or (choice == "auto" and len(names) <= _MOST_EXHAUSTIVE):
        return exhaustive_pairs(names)
    if choice == "sequential":
        return sequential_pairs(names)
    similar = similar_pairs(names, _global_descriptors(features, seed))
    return similar if choice == "similar" else sorted({*sequential_pairs(names), *similar})


def unsure_pairs(names: Iterable[str], pairs: Pairs, choice: PairChoice) -> frozenset[tuple[str, str]]:
    """The pairs to match only if they look alike: with "auto", of many images those that are no neighbors."""
    names = list(names)
    if choice != "auto" or len(names) <= _MOST_SURE:
        return frozenset()
    return frozenset(pairs).difference(sequential_pairs(names))


def _global_descriptors(features: Mapping[str, Features], seed: int) -> Float32[np.ndarray, "n kd"]:
    """Global descriptors of images by a vocabulary that is learned from the same images."""
    names = sorted(features)
    share = max(1, _WORD_SAMPLES // len(names))
    generator = np.random.default_rng(seed)
    parts = [unit_rows(generator.permutation(features[name].descriptors, axis=0)[:share]) for name in names]
    samples = np.concatenate(parts)
    words = learn_words(samples, seed) if len(samples) else np.zeros((1, samples.shape[1]), np.float32)
    return np.stack([vlad(unit_rows(features[name].descriptors), words) for name in names])


def exhaustive_pairs(names: Iterable[str]) -> Pairs:
    """All pairs of images."""
    return list(combinations(sorted(names), 2))


def sequential_pairs(names: Iterable[str], *, overlap: int = 10) -> Pairs:
    """Each image with the next `overlap` images and with the images 2, 4, 8 ... further on.

    Meant for the frames of a video. Numbers in names count as numbers: frame2 comes before frame10.
    """
    ordered = in_order(names)
    steps = [*range(1, overlap + 1), *(overlap + 2**i for i in range(1, overlap.bit_length() + 1))]
    found = (tuple(sorted((ordered[i], ordered[i + k]))) for k in steps for i in range(len(ordered) - k))
    return sorted({(a, b) for a, b in found})


def similar_pairs(names: list[str], descriptors: Float32[np.ndarray, "n d"], *, k: int = 20) -> Pairs:
    """Each image with the k images of most similar global descriptors, by the dot product."""
    similarities = descriptors @ descriptors.T
    np.fill_diagonal(similarities, -np.inf)
    nearest = np.argsort(-similarities, axis=1, kind="stable")[:, : min(k, len(names) - 1)]
    found = (tuple(sorted((names[i], names[j]))) for i in range(len(names)) for j in nearest[i])
    return sorted({(a, b) for a, b in found})


def in_order(names: Iterable[str]) -> list[str]:
    """Sort names so that numbers in them count as numbers: frame2 comes before frame10."""
    return sorted(names, key=_natural)


def _natural(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]
