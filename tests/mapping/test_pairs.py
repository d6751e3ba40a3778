import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slimsfm.features import Features, unit_rows
from slimsfm.mapping.pairs import (
    choose_pairs,
    exhaustive_pairs,
    sequential_pairs,
    similar_pairs,
    unsure_pairs,
)

NAMES = st.lists(st.text("ab01²/ .", min_size=1, max_size=6), min_size=2, max_size=15, unique=True)


def features_of(descriptors):
    count = len(descriptors)
    return Features(
        keypoints=np.zeros((count, 2), np.float32),
        descriptors=descriptors,
        scores=np.ones(count, np.float32),
        image_size=(64, 48),
    )


def assert_pairs(pairs, names):
    assert pairs == sorted(set(pairs))
    assert all(a < b and a in names and b in names for a, b in pairs)


@given(names=NAMES)
def test_exhaustive_pairs_are_all_pairs(names):
    pairs = exhaustive_pairs(names)
    assert_pairs(pairs, names)
    assert len(pairs) == len(names) * (len(names) - 1) // 2


@given(names=NAMES, overlap=st.integers(1, 4))
def test_sequential_pairs_connect_all_images(names, overlap):
    pairs = sequential_pairs(names, overlap=overlap)
    assert_pairs(pairs, names)
    assert len(pairs) >= len(names) - 1
    reached = {names[0]}
    for _ in names:
        reached |= {name for pair in pairs for name in pair if reached & set(pair)}
    assert reached == set(names)


def test_sequential_pairs_follow_the_numbers_in_the_names():
    names = [f"frame{i}.png" for i in range(30)]
    pairs = {tuple(sorted(int(name[5:-4]) for name in pair)) for pair in sequential_pairs(names, overlap=2)}
    assert pairs == {(i, i + k) for k in (1, 2, 4, 6) for i in range(30 - k)}


def test_names_with_digits_that_are_not_decimals_are_ordered():
    assert sequential_pairs(["1²2.png", "1b.png", "x.png"])


def take(rng, groups, per_group, count=60):
    """Images in groups that share their descriptors up to noise."""
    features = {}
    for group in range(groups):
        words = unit_rows(np.abs(rng.normal(size=(count, 32))).astype(np.float32))
        for i in range(per_group):
            noisy = np.clip(words + 0.02 * rng.normal(size=words.shape), 0, 1)
            name = f"{i}-{group}.png"  # lookalikes are far apart in order of name
            features[name] = features_of((255 * noisy).astype(np.uint8))
    return features


def test_lookalikes_are_paired():
    features = take(np.random.default_rng(0), groups=7, per_group=4)
    names = sorted(features)
    descriptors = np.stack(
        [unit_rows(features[n].descriptors).mean(axis=0, keepdims=True) for n in names]
    ).astype(np.float32)[:, 0]
    pairs = similar_pairs(names, unit_rows(descriptors), k=3)
    assert_pairs(pairs, names)
    assert set(pairs) == {(a, b) for a, b in exhaustive_pairs(names) if a[1:] == b[1:]}


def test_lookalikes_are_found_by_their_features():
    features = take(np.random.default_rng(1), groups=30, per_group=2)
    pairs = set(choose_pairs(features, "similar", seed=0))
    planted = {(a, b) for a, b in exhaustive_pairs(features) if a[1:] == b[1:]}
    assert len(planted) == 30
    assert planted <= pairs
    assert len(pairs) < len(exhaustive_pairs(features))
    assert choose_pairs(features, "similar", seed=0) == choose_pairs(features, "similar", seed=0)


@pytest.mark.parametrize("choice", ["similar", "exhaustive", "sequential", "auto"])
@pytest.mark.parametrize("counts", [(0, 3, 5), (1, 1, 1), (0, 0, 0)])
def test_images_with_few_features_are_paired(choice, counts):
    rng = np.random.default_rng(0)
    features = {
        f"{i}.png": features_of(rng.integers(0, 255, (count, 16)).astype(np.uint8))
        for i, count in enumerate(counts)
    }
    assert choose_pairs(features, choice, seed=0) == exhaustive_pairs(features)


def test_auto_is_exhaustive_up_to_200_images_and_sparser_above():
    rng = np.random.default_rng(0)
    features = {
        f"{i:03d}.png": features_of(rng.integers(0, 255, (4, 8)).astype(np.uint8)) for i in range(201)
    }
    few = dict(list(features.items())[:200])
    assert choose_pairs(few, "auto", seed=0) == exhaustive_pairs(few)
    many = choose_pairs(features, "auto", seed=0)
    assert_pairs(many, features)
    assert len(many) < 0.5 * len(exhaustive_pairs(features))
    assert set(many) == {*sequential_pairs(features), *choose_pairs(features, "similar", seed=0)}


def test_of_many_images_only_neighbors_are_sure_to_be_matched():
    names = [f"frame{i}.png" for i in range(61)]
    pairs = exhaustive_pairs(names)
    assert unsure_pairs(names, pairs, "auto") == set(pairs) - set(sequential_pairs(names))
    assert not unsure_pairs(names, pairs, "exhaustive")
    assert not unsure_pairs(names[1:], exhaustive_pairs(names[1:]), "auto")
