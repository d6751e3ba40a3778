import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slimsfm.features import unit_rows
from slimsfm.features.nearest import NUM_WORDS, learn_words, nearest_word, vlad


def descriptors(count, seed=0):
    return unit_rows(np.random.default_rng(seed).normal(size=(count, 16)).astype(np.float32))


WORDS = learn_words(descriptors(500))


def test_words_are_as_many_as_there_can_be():
    assert WORDS.shape == (NUM_WORDS, 16)
    assert learn_words(descriptors(5)).shape == (5, 16)
    with pytest.raises(ValueError, match="at least one row"):
        learn_words(descriptors(0))


def test_equal_descriptors_give_equal_words():
    assert np.array_equal(learn_words(descriptors(30_000)), learn_words(descriptors(30_000)))
    assert not np.array_equal(learn_words(descriptors(30_000)), learn_words(descriptors(30_000), seed=1))


def test_the_nearest_word_is_the_nearest():
    rows = descriptors(40, seed=3)
    distances = np.linalg.norm(rows[:, None] - WORDS[None], axis=2)
    assert np.array_equal(nearest_word(rows, WORDS), distances.argmin(axis=1))


@given(count=st.integers(1, 200), seed=st.integers(0, 100))
def test_a_global_descriptor_has_unit_length_and_knows_no_order(count, seed):
    rows = descriptors(count, seed)
    one = vlad(rows, WORDS)
    assert np.linalg.norm(one) == pytest.approx(1, abs=1e-4)
    assert np.allclose(vlad(rows[::-1].copy(), WORDS), one, atol=1e-5)


def test_repeating_a_texture_changes_nothing():
    rows = descriptors(60)
    assert np.allclose(vlad(np.concatenate([rows, rows, rows]), WORDS), vlad(rows, WORDS), atol=1e-5)


def test_nothing_looks_like_nothing():
    assert not vlad(descriptors(0), WORDS).any()


def test_images_of_common_texture_look_alike():
    of_object = descriptors(80, seed=1)
    images = [vlad(np.concatenate([of_object, descriptors(40, seed=s)]), WORDS) for s in (2, 3)]
    assert images[0] @ images[1] > 2 * abs(images[0] @ vlad(descriptors(120, seed=4), WORDS))
