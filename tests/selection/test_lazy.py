from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slimsfm.selection import problem as lazy


class Coverage:
    """A sum of weighted concave functions of how often each of some things is covered: submodular."""

    def __init__(self, seed, num_items, *, integer):
        rng = np.random.default_rng(seed)
        self.covers = rng.random((num_items, 6)) < rng.random()
        self.weights = rng.integers(1, 3, 6).astype(float) if integer else rng.random(6)
        self.often = np.zeros(6)
        self.curve = (lambda x: np.minimum(x, 2)) if integer else np.sqrt

    def gains(self, items):
        gain = (self.curve(self.often + 1) - self.curve(self.often)) * self.weights
        return (self.covers[items] * gain).sum(axis=1).astype(float)

    def choose(self, item):
        self.often += self.covers[item]


def eager_order(function, allowed):
    chosen, free = [], allowed.copy()
    while True:
        gains = np.where(free, function.gains(np.arange(len(free))), 0)
        if gains.max(initial=0) <= 1e-9:
            return chosen
        chosen.append(int(gains.argmax()))
        free[chosen[-1]] = False
        function.choose(chosen[-1])


def lazy_order(function, allowed, slack):
    chosen = []
    first = function.gains(np.arange(len(allowed))) + slack
    for item in lazy.greedy_order(first, function.gains, allowed):
        chosen.append(item)
        function.choose(item)
    return chosen


@pytest.mark.parametrize(("front", "batch"), [(4096, 32), (1, 1), (3, 2)])
@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    num_items=st.integers(0, 40),
    integer=st.booleans(),
    slack=st.sampled_from([0.0, 0.3]),
)
def test_lazy_is_eager_on_submodular_functions(front, batch, seed, num_items, integer, slack):
    allowed = np.random.default_rng(seed + 1).random(num_items) < 0.8
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lazy, "_FRONT", front)
        patch.setattr(lazy, "_BATCH", batch)
        ours = lazy_order(Coverage(seed, num_items, integer=integer), allowed, slack)
    assert ours == eager_order(Coverage(seed, num_items, integer=integer), allowed)


def test_few_gains_are_evaluated_where_choices_do_not_disturb_each_other():
    evaluated = []

    def gains(items):
        evaluated.extend(items.tolist())
        return values[items]

    values = np.random.default_rng(0).random(10_000)
    chosen = list(islice(lazy.greedy_order(values, gains, np.ones(10_000, bool)), 50))
    assert chosen == np.argsort(-values)[:50].tolist()
    assert len(evaluated) <= 50 * 32
