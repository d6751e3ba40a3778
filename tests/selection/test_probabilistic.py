import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selection.random_problems import problem_of, problems, users
from slimsfm.selection import probabilistic
from slimsfm.selection.probabilistic import _Choice, match_probabilities

quick = settings(deadline=None, max_examples=40)


def distribution(probabilities):
    """Of the number of successes, by multiplying their generating functions."""
    terms = np.ones(1)
    for p in probabilities:
        terms = np.convolve(terms, [1 - p, p])
    return terms


def eager(problem, cover):
    """The two stages by the definition: all gains of all points from the distributions, each time."""
    uses, p, chosen = users(problem), match_probabilities(problem), []

    def terms(image, more=()):
        return distribution(p[[q for q in (*chosen, *more) if uses[image, q]]])

    def expectation(image, point):
        mean = terms(image) @ np.arange(len(terms(image)))
        return p[point] * (mean < cover - 1e-9)

    def certainty(image, point):
        before = terms(image)[cover:].sum()
        return (terms(image, [point])[cover:].sum() - before) * (before < 0.99)

    for gain in (expectation, certainty):
        while len(chosen) < uses.shape[1]:
            gains = [
                sum(gain(i, q) for i in np.flatnonzero(uses[:, q])) * (q not in chosen)
                for q in range(uses.shape[1])
            ]
            if max(gains) < 1e-9:
                break
            chosen.append(int(np.argmax(np.round(gains, 12))))
    return chosen


def made(problem, cover):
    choice = _Choice(problem, int(problem.points_an_image.max(initial=1)))
    choice.extend(cover, problem.num_points)
    return choice.chosen


@pytest.mark.parametrize("uses", [0, 1, 5])
def test_a_point_that_more_images_use_is_likelier_to_be_matched(uses):
    column = np.arange(5)[:, None] < uses
    assert match_probabilities(problem_of(column)) == pytest.approx((uses + 1) / (uses + 2))


@quick
@given(problem=problems(), data=st.data())
def test_every_image_very_likely_has_its_matches_or_uses_all_its_points(problem, data):
    cover = data.draw(st.integers(1, max(1, int(problem.points_an_image.max(initial=0)))))
    chosen, uses, p = made(problem, cover), users(problem), match_probabilities(problem)
    kept = np.isin(np.arange(problem.num_points), chosen)
    for image in uses:
        sure = distribution(p[image & kept])[cover:].sum() >= 0.99 - 1e-9
        assert sure or not (image & ~kept).any()


@settings(deadline=None, max_examples=25)
@given(problem=problems(max_images=4, max_points=12), cover=st.integers(1, 4))
def test_the_lazy_choice_is_as_large_as_the_eager_one(problem, cover):
    if cover <= problem.points_an_image.max(initial=0):
        assert len(made(problem, cover)) == len(eager(problem, cover))


@pytest.mark.parametrize("seed", range(4))
def test_the_lazy_choice_is_the_eager_one_where_few_gains_are_equal(seed):
    uses = np.random.default_rng(seed).random((12, 30)) < np.linspace(0.1, 0.5, 12)[:, None]
    assert made(problem_of(uses), 4) == eager(problem_of(uses), 4)


def test_it_spends_its_budget_on_more_certain_points_first():
    uses = np.zeros((4, 40), bool)
    uses[:, :20] = True
    uses[0, 20:] = True
    assert (probabilistic(problem_of(uses), 12) < 20).all()
