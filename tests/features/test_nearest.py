import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slimsfm.features import NearestOptions, match_nearest, unit_rows


def random_units(rng, count, dimension):
    return unit_rows(rng.normal(size=(count, dimension)).astype(np.float32))


def by_definition(a, b, options):
    """Mutual nearest neighbors that pass the ratio and the distance test, one by one."""
    angles = np.arccos(np.clip(a @ b.T, -1, 1))
    pairs = []
    for i, row in enumerate(angles):
        order = np.argsort(row)
        j = order[0]
        second = row[order[1]] if len(order) > 1 else np.pi
        if angles[:, j].argmin() == i and row[j] <= min(options.max_ratio * second, options.max_distance):
            pairs.append((i, int(j)))
    return np.array(pairs, np.int64).reshape(-1, 2)


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 12),
    m=st.integers(0, 12),
    ratio=st.floats(0.1, 1),
    distance=st.floats(0.05, 2),
)
def test_matches_are_those_of_the_definition(seed, n, m, ratio, distance):
    rng = np.random.default_rng(seed)
    a, b = random_units(rng, n, 3), random_units(rng, m, 3)
    options = NearestOptions(max_ratio=ratio, max_distance=distance)
    expected = by_definition(a, b, options) if n and m else np.zeros((0, 2))
    assert np.array_equal(match_nearest(a, b, options), expected)


def test_matches_are_those_of_the_definition_over_many_blocks():
    rng = np.random.default_rng(0)
    b = random_units(rng, 700, 8)
    a = unit_rows(b[rng.permutation(700)[:600]] + 0.1 * rng.normal(size=(600, 8)).astype(np.float32))
    pairs = match_nearest(a, b)
    assert len(pairs) > 100
    assert np.array_equal(pairs, by_definition(a, b, NearestOptions()))


@given(seed=st.integers(0, 2**32 - 1))
def test_no_row_is_matched_twice_and_without_a_ratio_test_both_ways_agree(seed):
    rng = np.random.default_rng(seed)
    a, b = (unit_rows(rng.integers(0, 2, (15, 3)).astype(np.float32)) for _ in range(2))  # with many ties
    pairs = match_nearest(a, b, NearestOptions(max_ratio=1.0))
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)
    assert np.all(np.diff(pairs[:, 0]) > 0)
    a, b = random_units(rng, 15, 4), random_units(rng, 10, 4)
    there, back = (match_nearest(*sets, NearestOptions(max_ratio=1.0)) for sets in ((a, b), (b, a)))
    assert set(map(tuple, there.tolist())) == {(i, j) for j, i in back.tolist()}


def test_a_set_matches_itself():
    descriptors = random_units(np.random.default_rng(0), 50, 32)
    assert np.array_equal(match_nearest(descriptors, descriptors), np.repeat(np.arange(50), 2).reshape(-1, 2))


def test_descriptors_of_zeros_match_nothing():
    descriptors = random_units(np.random.default_rng(0), 5, 8)
    zeros = np.zeros((3, 8), np.float32)
    assert len(match_nearest(zeros, descriptors)) == len(match_nearest(descriptors, zeros)) == 0


def test_the_arguments_are_left_alone():
    a, b = (random_units(np.random.default_rng(i), 20, 8) for i in range(2))
    before = a.copy(), b.copy()
    match_nearest(a, b)
    assert np.array_equal(a, before[0])
    assert np.array_equal(b, before[1])


@pytest.mark.parametrize("values", [{"max_ratio": 0.0}, {"max_ratio": 1.5}, {"max_distance": 0.0}], ids=str)
def test_bad_options_are_named(values):
    with pytest.raises(ValueError, match=next(iter(values))):
        NearestOptions(**values)


def by_definition_of_groups(a, b, groups, options):
    """Each group stands for its most similar row; then mutual nearest, ratio and distance, one by one."""
    angles = np.arccos(np.clip(a @ b.T, -1, 1))
    of_groups = np.stack([angles[:, groups == one].min(axis=1) for one in np.unique(groups)], axis=1)
    pairs = []
    for i, row in enumerate(of_groups):
        order = np.argsort(row)
        second = row[order[1]] if len(order) > 1 else np.pi
        limit = min(options.max_ratio * second, options.max_distance)
        if of_groups[:, order[0]].argmin() == i and row[order[0]] <= limit:
            pairs.append((i, int(np.flatnonzero(groups == np.unique(groups)[order[0]])[0])))
    return np.array(pairs, np.int64).reshape(-1, 2)


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 12),
    m=st.integers(1, 20),
    ratio=st.floats(0.1, 1),
    distance=st.floats(0.05, 2),
)
def test_groups_match_by_their_most_similar_row_and_rival_other_groups_only(seed, n, m, ratio, distance):
    rng = np.random.default_rng(seed)
    a, b = random_units(rng, n, 3), random_units(rng, m, 3)
    groups = np.sort(rng.integers(0, 8, m))
    options = NearestOptions(max_ratio=ratio, max_distance=distance)
    found = match_nearest(a, b, options, firsts=np.unique(groups, return_index=True)[1])
    assert np.array_equal(found, by_definition_of_groups(a, b, groups, options))


def test_groups_of_one_row_match_as_rows_do_and_repeated_rows_change_nothing():
    rng = np.random.default_rng(0)
    b = random_units(rng, 700, 8)
    a = unit_rows(b[rng.permutation(700)[:600]] + 0.1 * rng.normal(size=(600, 8)).astype(np.float32))
    plain = match_nearest(a, b)
    assert np.array_equal(match_nearest(a, b, firsts=np.arange(700)), plain)
    rows = np.repeat(np.arange(700), rng.integers(1, 4, 700))
    repeated = match_nearest(a, b[rows], firsts=np.unique(rows, return_index=True)[1])
    assert np.array_equal(np.column_stack([repeated[:, 0], rows[repeated[:, 1]]]), plain)
