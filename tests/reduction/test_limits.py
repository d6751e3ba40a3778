"""Limits, and the candidate that is taken within them."""

from dataclasses import fields, replace
from math import inf

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from candidates import DIAGONAL, FULL_BYTES, MISSED, candidate, frontier_of, with_errors
from slimsfm.errors import InputError
from slimsfm.reduction import ReductionLimits, recommend

CANDIDATES = st.lists(
    st.fixed_dictionaries(
        {
            "use": st.sampled_from(["direct", "images"]),
            "method": st.sampled_from(["kcover", "information", "dominating"]),
            "points": st.integers(1, 60),
            "images": st.integers(0, 4),
            "size": st.integers(1, 12),
            "missed": st.integers(-MISSED, 6),
            "ms": st.integers(1, 9).map(float),
            "error": st.sampled_from([0.001, 0.002]),
        }
    ),
    min_size=1,
    max_size=8,
)
AIMED_MEDIAN, AIMED_P90 = 1.5, 2.0
RESERVE = 2  # times the points of the smallest candidate that loses nothing
USES = st.sampled_from(["direct", "images"])


def made(facts):
    """Candidates; only those for images keep some."""
    return [candidate(**{**one, "images": one["images"] * (one["use"] == "images")}) for one in facts]


def maybe(values):
    return st.none() | values


LIMITS = st.builds(
    ReductionLimits,
    max_loss=maybe(st.integers(0, 30).map(float)),
    max_bytes=maybe(st.integers(1, 12).map(float)),
    max_ms=maybe(st.integers(1, 9).map(float)),
    max_points=maybe(st.integers(1, 60)),
    max_images=maybe(st.integers(0, 4)),
)


def meets(one, limits):
    found = {
        "max_loss": one.loss,
        "max_bytes": one.bytes,
        "max_ms": 1e3 * one.seconds,
        "max_points": len(one.choice.points),
        "max_images": len(one.choice.images),
    }
    return all(
        getattr(limits, name) is None or value <= getattr(limits, name) for name, value in found.items()
    )


def size(one):
    """Fewer images first, then fewer points, then the smaller error."""
    return len(one.choice.images), len(one.choice.points), one.prediction.median_error


def exceeded(one):
    return max(one.growth.median / AIMED_MEDIAN, one.growth.p90 / AIMED_P90, 1.0)


def may_be_taken(one, use):
    return one.choice.use == use and (use, one.choice.method) != ("direct", "dominating")


@given(facts=CANDIDATES, use=USES, limits=LIMITS)
def test_the_candidate_taken_meets_every_limit_unless_none_does(facts, use, limits):
    candidates = made(facts)
    fitting = [one for one in candidates if may_be_taken(one, use) and meets(one, limits)]
    if not fitting:
        with pytest.raises(InputError, match=f"for {use}"):
            recommend(frontier_of(*candidates), use, limits)
        return
    taken = recommend(frontier_of(*candidates), use, limits)
    assert any(taken is one for one in fitting)
    if limits.max_loss is not None:
        assert size(taken) == min(size(one) for one in fitting)


@given(facts=CANDIDATES, use=USES, limits=LIMITS)
def test_without_a_largest_loss_the_smallest_of_least_loss_is_taken_or_one_twice_as_large(facts, use, limits):
    candidates = made({**one, "error": 0.001} for one in facts)
    limits = replace(limits, max_loss=None, max_median_factor=inf, max_p90_factor=inf)
    fitting = [one for one in candidates if may_be_taken(one, use) and meets(one, limits)]
    assume(fitting)
    taken = recommend(frontier_of(*candidates), use, limits)
    allowed = max(min(one.loss for one in fitting), 0.0)
    smallest = [one for one in fitting if one.loss <= allowed]
    least = min(size(one) for one in smallest)
    assert any(
        taken is one
        or (
            use == "direct"
            and taken.choice.method == one.choice.method
            and len(taken.choice.points) >= RESERVE * len(one.choice.points)
        )
        for one in smallest
        if size(one) == least
    )


@given(facts=CANDIDATES, use=USES)
def test_no_larger_lossless_candidate_is_nearer_to_the_aimed_growth_than_the_one_taken(facts, use):
    candidates = made(facts)
    usable = [one for one in candidates if may_be_taken(one, use)]
    assume(usable)
    taken = recommend(frontier_of(*candidates), use)
    least = max(min(one.loss for one in usable), 0.0)
    larger = [
        one for one in usable if one.loss <= least and len(one.choice.points) > len(taken.choice.points)
    ]
    assert all(exceeded(taken) <= exceeded(one) for one in larger)


@given(facts=CANDIDATES, use=USES, limits=LIMITS, seed=st.randoms(use_true_random=False))
def test_the_order_of_the_candidates_does_not_matter(facts, use, limits, seed):
    candidates = made(facts)
    keys = {size(one) for one in candidates}
    assume(len(keys) == len(candidates))
    assume(any(may_be_taken(one, use) and meets(one, limits) for one in candidates))
    shuffled = list(candidates)
    seed.shuffle(shuffled)
    taken = recommend(frontier_of(*candidates), use, limits)
    assert recommend(frontier_of(*shuffled), use, limits) is taken


def test_losses_are_points_lost_against_the_full_map():
    assert candidate(missed=2).losses == pytest.approx((10.0, 10.0, 10.0))
    assert candidate(missed=-2).loss == pytest.approx(-10.0)
    assert candidate(missed=0).loss == 0.0


def test_the_reserve_is_twice_as_many_points_by_the_same_method():
    small = candidate(points=100, size=1000)
    larger = candidate(points=199, size=1990)
    enough = candidate(points=200, size=2000, missed=1)
    more = candidate(points=300, size=3000)
    other = candidate(points=200, size=1900, method="information")
    found = frontier_of(small, larger, enough, more, other)
    assert recommend(found, "direct") is enough
    assert recommend(found, "direct", ReductionLimits(max_loss=0.0)) is small
    assert recommend(found, "direct", ReductionLimits(max_bytes=1999.0)) is small
    assert recommend(found, "direct", ReductionLimits(max_points=199)) is small
    assert recommend(frontier_of(small, larger, more, other), "direct") is more


def test_of_as_many_points_those_of_the_least_error_are_taken():
    one, two = candidate(error=0.0014, size=990), candidate(error=0.001, method="information")
    assert recommend(frontier_of(one, two), "direct") is two
    assert recommend(frontier_of(one, two), "direct", ReductionLimits(max_loss=0.0)) is two


def test_a_choice_that_loses_rough_queries_is_replaced_by_the_smallest_that_does_not():
    small = candidate(points=100, size=900, rough=5)
    reserved = candidate(points=200, size=1200, rough=3)
    better = candidate(points=300, size=1500, method="information", rough=0)
    larger = candidate(points=400, size=1900, rough=-1)
    assert recommend(frontier_of(small, reserved, better, larger), "direct") is better
    lossy = candidate(points=300, size=1500, missed=1, rough=0)
    assert recommend(frontier_of(small, reserved, lossy, larger), "direct") is larger
    enough = candidate(points=200, size=1200, rough=0)
    assert recommend(frontier_of(small, enough, better), "direct") is enough


def test_a_reserve_for_rough_queries_stays_fifty_times_smaller_than_the_full_map():
    small = candidate(points=100, size=900, rough=5)
    half = candidate(points=300, size=FULL_BYTES // 50, rough=2)
    whole = candidate(points=400, size=FULL_BYTES // 50 + 1, rough=0)
    assert recommend(frontier_of(small, half, whole), "direct") is half
    assert recommend(frontier_of(small, whole), "direct") is whole  # twice the points of the smallest
    assert recommend(frontier_of(candidate(points=250, rough=5), whole), "direct").choice.points.size == 250


def test_a_largest_loss_holds_for_rough_queries_too():
    small, large = candidate(rough=1, size=500), candidate(points=200, rough=0)
    assert recommend(frontier_of(small, large), "direct", ReductionLimits(max_loss=0.0)) is large
    assert recommend(frontier_of(small, large), "direct", ReductionLimits(max_loss=5.0)) is small
    with pytest.raises(InputError, match=r"loses 0\.0 points \(5\.0 on rough queries\)"):
        recommend(frontier_of(small), "direct", ReductionLimits(max_loss=1.0))


def test_growth_is_that_of_median_and_90th_percentile():
    growth = with_errors(candidate(), 0.002, 0.006).growth
    assert (growth.median, growth.p90) == pytest.approx((2.0, 3.0))


def test_errors_below_half_a_pixel_are_equal():
    within = with_errors(candidate(), 0.0004, 0.0009, full_median=1e-5, full_p90=1e-4, finest=0.001).growth
    assert (within.median, within.p90) == (1.0, 1.0)
    above = with_errors(candidate(), 0.002, 0.003, full_median=1e-5, full_p90=1e-4, finest=0.001).growth
    assert (above.median, above.p90) == pytest.approx((2.0, 3.0))


def test_what_neither_map_localizes_does_not_grow_and_what_only_the_full_map_does_grows_without_limit():
    neither = with_errors(candidate(), 0.001, float("inf"), full_p90=float("inf")).growth
    assert neither.p90 == 1.0
    assert with_errors(candidate(), 0.001, float("inf")).growth.p90 == float("inf")


def test_errors_that_grow_are_answered_by_the_smallest_choice_within_the_aims_or_the_nearest():
    small = with_errors(candidate(points=100), 0.004, 0.008)
    double = with_errors(candidate(points=200), 0.0016, 0.005)
    exact = with_errors(candidate(points=300), AIMED_MEDIAN * 0.001, AIMED_P90 * 0.002)
    larger = with_errors(candidate(points=400), 0.001, 0.002)
    assert recommend(frontier_of(small, double, exact, larger), "direct") is exact
    assert recommend(frontier_of(small, double), "direct") is double
    huge = with_errors(candidate(points=300, size=FULL_BYTES // 50 + 1), 0.001, 0.002)
    assert recommend(frontier_of(small, double, huge), "direct") is double


def test_limits_on_the_growth_replace_the_aims():
    small = with_errors(candidate(points=100), 0.0029, 0.005)
    double = with_errors(candidate(points=200), 0.0025, 0.004)
    exact = with_errors(candidate(points=300), 0.001, 0.002)
    found = frontier_of(small, double, exact)
    assert recommend(found, "direct") is exact
    assert recommend(found, "direct", ReductionLimits(max_median_factor=3.0)) is double
    assert recommend(found, "direct", ReductionLimits(max_median_factor=3.0, max_p90_factor=3.0)) is double
    assert recommend(found, "direct", ReductionLimits(max_p90_factor=1.9)) is exact
    assert recommend(found, "direct", ReductionLimits(max_loss=0.0)) is small
    assert recommend(found, "direct", ReductionLimits(max_loss=0.0, max_median_factor=2.6)) is double
    with pytest.raises(InputError, match=r"corner error of 0.002d \(90th percentile\), 1 times"):
        recommend(found, "direct", ReductionLimits(max_p90_factor=0.9))


def test_a_largest_error_is_that_of_the_90th_percentile():
    small = with_errors(candidate(points=100), 0.004, 0.008)
    double = with_errors(candidate(points=200), 0.003, 0.006)
    larger = with_errors(candidate(points=300), 0.003, 0.004)
    found = frontier_of(small, double, larger)
    for limit in (0.009, 0.006, 0.004):
        in_units = recommend(found, "direct", ReductionLimits(max_error=limit * DIAGONAL))
        assert in_units is recommend(found, "direct", ReductionLimits(max_relative_error=limit))
        assert in_units is (larger if limit < 0.006 else double)
    with pytest.raises(InputError, match=r"meets max_error 0\.003d; the nearest"):
        recommend(found, "direct", ReductionLimits(max_relative_error=0.003))


def test_images_need_no_reserve():
    small = candidate(use="images", method="dominating", points=100, images=2, size=1000)
    more = candidate(use="images", method="dominating", points=200, images=5, size=2000)
    assert recommend(frontier_of(small, more), "images") is small


def test_the_least_loss_is_taken_where_every_candidate_loses():
    bad = candidate(points=100, size=1000, missed=6)
    better = candidate(points=120, size=1200, missed=3)
    assert recommend(frontier_of(bad, better), "direct") is better


def test_a_gain_does_not_justify_more_points():
    enough = candidate(size=1000, missed=0)
    gain = candidate(points=120, size=1200, missed=-2)
    assert recommend(frontier_of(enough, gain), "direct") is enough


def test_points_of_a_dominating_set_are_listed_but_never_taken():
    paper = candidate(method="dominating", size=10)
    ours = candidate(size=1000, missed=6)
    assert recommend(frontier_of(paper, ours), "direct") is ours
    with pytest.raises(InputError, match="no way to reduce this map for direct"):
        recommend(frontier_of(paper), "direct")


@pytest.mark.parametrize(
    ("limits", "nearest"),
    [
        (ReductionLimits(max_bytes=1000.0), "kcover (100 points), has 100 points and 1234 bytes"),
        (
            ReductionLimits(max_loss=2.0),
            "kcover (200 points), has 200 points and 5678 bytes, loses 5.0 points",
        ),
        (ReductionLimits(max_ms=1.0), "kcover (100 points), has 100 points and 1234 bytes"),
        (ReductionLimits(max_loss=2.0, max_points=10), "kcover (100 points)"),
        (ReductionLimits(max_points=0), "kcover (100 points)"),
    ],
    ids=str,
)
def test_a_refusal_names_the_limits_and_the_nearest_candidate(limits, nearest):
    found = frontier_of(
        candidate(points=200, size=5678, missed=1, ms=7.0), candidate(points=100, size=1234, missed=6, ms=3.0)
    )
    with pytest.raises(InputError) as refusal:
        recommend(found, "direct", limits)
    message = str(refusal.value)
    assert message.startswith(f"no choice for direct meets {limits}; the nearest, ")
    assert nearest in message
    assert "\n" not in message


def test_limits_are_written_as_given():
    assert str(ReductionLimits(max_bytes=1000.0, max_loss=2.0)) == "max_loss 2, max_bytes 1000"


@pytest.mark.parametrize("name", [field.name for field in fields(ReductionLimits)])
def test_limits_are_not_negative(name):
    below = -1 if name in ("max_points", "max_images") else -1.0
    with pytest.raises(ValueError, match=f"{name} must not be negative, got -1"):
        ReductionLimits(**{name: below})


@given(facts=CANDIDATES)
def test_candidates_on_the_frontier_dominate_all_others(facts):
    candidates = made(facts)
    found = frontier_of(*candidates)
    best = [one for one in candidates if not found.is_pareto_dominated(one)]
    for one in candidates:
        better = [
            other
            for other in best
            if other.choice.use == one.choice.use
            and other.bytes <= one.bytes
            and other.loss <= one.loss
            and (other.bytes < one.bytes or other.loss < one.loss)
        ]
        assert found.is_pareto_dominated(one) == bool(better)
    assert {one.choice.use for one in best} == {one.choice.use for one in candidates}


@given(facts=CANDIDATES)
def test_no_candidate_dominates_itself_or_its_equal(facts):
    for one in made(facts):
        assert not frontier_of(one).is_pareto_dominated(one)
        assert not frontier_of(one, replace(one)).is_pareto_dominated(one)
