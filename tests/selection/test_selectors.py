import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_problems import problem_of, problems, reordered, users
from scipy.sparse import csr_array

from slimsfm.selection import SELECTORS, SelectionProblem

quick = settings(deadline=None, max_examples=40)
every_selector = pytest.mark.parametrize("select", SELECTORS.values(), ids=SELECTORS.keys())


@every_selector
@quick
@given(problem=problems(), count=st.integers(1, 40), seed=st.integers(0, 100))
def test_every_selector_gives_as_many_different_usable_points_as_wanted(select, problem, count, seed):
    chosen = select(problem, count, seed=seed)
    usable = np.flatnonzero(users(problem).any(axis=0))
    assert len(np.unique(chosen)) == len(chosen) == min(count, len(usable))
    assert np.isin(chosen, usable).all()
    assert chosen.dtype == np.int64


@every_selector
@quick
@given(problem=problems(), count=st.integers(1, 40), seed=st.integers(0, 100))
def test_equal_problems_and_seeds_give_equal_points(select, problem, count, seed):
    again = reordered(problem, np.arange(problem.num_images))
    assert np.array_equal(select(problem, count, seed=seed), select(again, count, seed=seed))


@pytest.mark.parametrize("name", ["information", "kcover", "random"])
@quick
@given(problem=problems(), count=st.integers(1, 40), seed=st.integers(0, 100))
def test_the_order_of_the_images_does_not_matter(name, problem, count, seed):
    images = np.random.default_rng(seed).permutation(problem.num_images)
    shuffled = SELECTORS[name](reordered(problem, images), count, seed=seed)
    assert np.array_equal(SELECTORS[name](problem, count, seed=seed), shuffled)


@every_selector
@quick
@given(problem=problems(), count=st.integers(1, 40))
def test_images_that_use_nothing_and_points_that_nobody_uses_change_nothing(select, problem, count):
    num_images, num_points = problem.num_images + 2, problem.num_points + 3
    wider = SelectionProblem(
        usable=csr_array(
            (
                problem.usable.data,
                problem.usable.indices,
                np.pad(problem.usable.indptr, (0, 2), mode="edge"),
            ),
            shape=(num_images, num_points),
        ),
        twists=problem.twists,
        corner_twists=np.concatenate([problem.corner_twists, np.ones((2, 24, 6), np.float32)]),
    )
    assert np.array_equal(select(problem, count), select(wider, count))


@every_selector
@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (3, 0), (3, 5)])
def test_where_nothing_is_usable_nothing_is_chosen(select, shape):
    assert len(select(problem_of(np.zeros(shape, bool)), 4)) == 0


@every_selector
@pytest.mark.parametrize("count", [0, -3])
def test_count_must_be_positive(select, count):
    with pytest.raises(ValueError, match=f"count must be positive, got {count}"):
        select(problem_of(np.ones((2, 3), bool)), count)


@pytest.mark.parametrize("name", ["information", "kcover"])
def test_an_image_apart_gets_its_share_however_few_its_points(name):
    uses = np.zeros((10, 100), bool)
    uses[:9, :90] = uses[9, 90:] = True
    chosen = SELECTORS[name](problem_of(uses), 20)
    assert (chosen >= 90).sum() >= 8


@quick
@given(problem=problems(), count=st.integers(1, 40), seed=st.integers(0, 100))
def test_fewer_points_at_random_are_a_beginning_of_more(problem, count, seed):
    select = SELECTORS["random"]
    longer = select(problem, count + 5, seed=seed)
    assert np.array_equal(select(problem, count, seed=seed), longer[:count])


def test_points_at_random_are_uniform():
    problem = problem_of(np.array([[True, True, False, True], [False, False, False, True]]))
    drawn = np.concatenate([SELECTORS["random"](problem, 1, seed=seed) for seed in range(1500)])
    counts = np.bincount(drawn, minlength=4)
    assert counts[2] == 0
    assert (abs(counts[[0, 1, 3]] - 500) < 75).all()
