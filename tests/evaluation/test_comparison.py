from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from handmade import DOMINATING, FULL, measurement_like, result_like, run_like
from scipy import stats

from slimsfm.errors import InputError
from slimsfm.evaluation.comparison import against_full, compare_measurements, compare_runs
from slimsfm.evaluation.table import BY_FRAME

RIGHT, WRONG = 0.01, 0.5
DIRECT = ("sift", "direct", "full")


def test_a_better_row_gains_and_a_worse_row_loses():
    poor = measurement_like(FULL, [RIGHT] * 4 + [WRONG] * 6)
    good = measurement_like(DOMINATING, [RIGHT] * 10)
    gain = compare_measurements("toy", [(poor, good)])
    assert (gain.object, gain.queries) == ("toy", 10)
    assert (gain.before, gain.after) == (FULL, DOMINATING)
    assert (gain.add_before, gain.add_after) == (40.0, 100.0)
    assert 0 < gain.add_gain.low < 60 < gain.add_gain.high <= 100
    loss = compare_measurements("toy", [(good, poor)])
    assert loss.add_gain.low == pytest.approx(-gain.add_gain.high)
    assert loss.add_gain.high == pytest.approx(-gain.add_gain.low)
    assert loss.p_value == gain.p_value == pytest.approx(stats.binomtest(6, 6).pvalue)


def test_faster_and_smaller_are_ratios():
    """Extraction does not count, because it is the same for both."""
    before = measurement_like(FULL, [RIGHT] * 3, seconds=(9.0, 0.3, 0.1), map_bytes=5000)
    after = measurement_like(DOMINATING, [RIGHT] * 3, seconds=(1.0, 0.05, 0.05), map_bytes=1000)
    found = compare_measurements("toy", [(before, after)])
    assert found.faster == pytest.approx(4.0)
    assert found.faster_between.low == pytest.approx(4.0)
    assert found.faster_between.high == pytest.approx(4.0)
    assert found.smaller == pytest.approx(5.0)
    back = compare_measurements("toy", [(after, before)])
    assert (back.faster, back.smaller) == pytest.approx((1 / 4, 1 / 5))


def test_equal_rows_neither_gain_nor_lose():
    cell = measurement_like(FULL, [RIGHT, WRONG, np.inf])
    found = compare_measurements("toy", [(cell, cell)])
    assert found.add_gain.low == found.add_gain.high == 0.0
    assert (found.p_value, found.faster, found.smaller) == (1.0, 1.0, 1.0)


def test_queries_are_compared_one_by_one():
    """Half are correct with either map; only if they differ, the interval has a width."""
    half = measurement_like(FULL, [RIGHT, WRONG] * 10)
    same, other = (
        measurement_like(DOMINATING, [RIGHT, WRONG] * 10),
        measurement_like(DOMINATING, [WRONG, RIGHT] * 10),
    )
    assert compare_measurements("toy", [(half, same)]).add_gain.high == 0.0
    assert compare_measurements("toy", [(half, other)]).add_gain.high > 20.0


def test_over_several_objects_all_queries_have_equal_weights():
    few = (
        measurement_like(FULL, [WRONG] * 2, map_bytes=100),
        measurement_like(DOMINATING, [RIGHT] * 2, map_bytes=50),
    )
    many = (
        measurement_like(FULL, [RIGHT] * 6, map_bytes=300),
        measurement_like(DOMINATING, [RIGHT] * 6, map_bytes=50),
    )
    found = compare_measurements(BY_FRAME, [few, many])
    assert found.queries == 8
    assert (found.add_before, found.add_after) == (75.0, 100.0)
    assert found.add_gain.low == found.add_gain.high == 25.0  # within each object nothing varies
    assert found.smaller == pytest.approx(200 / 50)
    assert found.p_value == pytest.approx(stats.binomtest(2, 2).pvalue)


def test_a_query_counts_with_its_mean_over_draws():
    full = measurement_like(FULL, [RIGHT, RIGHT, WRONG], seconds=(0.0, 0.1, 0.1))
    random = measurement_like(
        ("sift", "exhaustive", "random"),
        [RIGHT, WRONG, WRONG],
        [WRONG, WRONG, WRONG],
        seconds=(0.0, 0.05, 0.05),
    )
    found = compare_measurements("toy", [(full, random)])
    assert found.queries == 3
    assert found.add_after == pytest.approx(100 * 0.5 / 3)
    assert found.faster == pytest.approx(2.0)


def test_each_row_is_compared_with_the_full_map_of_its_method_and_strategy():
    methods, strategies = ("sift", "aliked"), ("exhaustive", "direct")
    keys = [(m, s, v) for m in methods for s in strategies for v in ("full", "dominating", "random:8")]
    found = against_full([result_like("toy", *(measurement_like(key, [RIGHT]) for key in keys))])
    assert [(one.before, one.after) for one in found] == [
        ((m, s, "full"), (m, s, v)) for m, s, v in keys if v != "full"
    ]


@pytest.mark.parametrize("variant", ["default", "points:300"])
def test_maps_for_direct_matching_are_compared_with_exhaustive_matching_of_the_full_map(variant):
    chosen = ("sift", "direct", variant)
    cells = [measurement_like(key, [RIGHT]) for key in (FULL, DIRECT, chosen)]
    (found,) = against_full([result_like("toy", *cells)])
    assert (found.before, found.after) == (FULL, chosen)
    (found,) = against_full([result_like("toy", *cells[1:])])
    assert (found.before, found.after) == (DIRECT, chosen)
    assert against_full([result_like("toy", cells[2])]) == []


def test_the_comparison_over_all_objects_comes_first():
    cells = measurement_like(FULL, [RIGHT] * 2), measurement_like(DOMINATING, [RIGHT] * 2)
    one, other = (result_like(name, *cells) for name in ("can", "mug"))
    assert [found.object for found in against_full([one, other])] == [BY_FRAME, "can", "mug"]
    assert [found.object for found in against_full([one])] == ["can"]
    lonely = result_like("mug", cells[0])
    assert [found.object for found in against_full([one, lonely])] == ["can"]


def test_plain_values_name_both_rows():
    before, after = measurement_like(FULL, [WRONG]), measurement_like(DOMINATING, [RIGHT])
    values = compare_measurements("toy", [(before, after)]).to_json()
    assert values["before"] == {"method": "sift", "strategy": "exhaustive", "variant": "full"}
    assert values["after"]["variant"] == "dominating"
    assert (values["add_0.1d_before"], values["add_0.1d_after"]) == (0.0, 100.0)
    assert (values["add_gain_low"], values["add_gain_high"]) == (100.0, 100.0)


@pytest.fixture
def runs():
    """Two runs: `can` has equal queries and one common row, `mug` has other queries, `jar` is in one run."""
    slow, quick = {"seconds": (0.1, 0.4, 0.0)}, {"seconds": (0.1, 0.1, 0.0)}
    before = [
        result_like(
            "can", measurement_like(FULL, [WRONG, RIGHT], **slow), measurement_like(DIRECT, [RIGHT] * 2)
        ),
        result_like("mug", measurement_like(FULL, [RIGHT]), queries=["a.png"]),
        result_like("jar", measurement_like(FULL, [RIGHT])),
    ]
    after = [
        result_like(
            "can", measurement_like(DOMINATING, [RIGHT] * 2), measurement_like(FULL, [RIGHT] * 2, **quick)
        ),
        result_like("mug", measurement_like(FULL, [RIGHT]), queries=["b.png"]),
    ]
    return run_like(*before, folder=Path("old")), run_like(*after, folder=Path("new"))


def test_runs_are_compared_on_common_rows(runs):
    (found,) = compare_runs(*runs)
    assert (found.object, found.before, found.after) == ("can", FULL, FULL)
    assert (found.add_before, found.add_after) == (50.0, 100.0)
    assert found.faster == pytest.approx(4.0)
    (back,) = compare_runs(*reversed(runs))
    assert (back.add_before, back.add_after) == (100.0, 50.0)


def test_a_run_equals_itself(runs):
    found = compare_runs(runs[0], runs[0])
    assert [(one.object, one.after) for one in found] == [
        (BY_FRAME, FULL),
        ("can", FULL),
        ("can", DIRECT),
        ("mug", FULL),
        ("jar", FULL),
    ]
    assert {one.p_value for one in found} == {one.faster for one in found} == {1.0}


def test_runs_without_common_rows_are_an_error(runs):
    before, after = runs
    with pytest.raises(InputError, match=r"old and new: the runs have no row in common"):
        compare_runs(before, replace(after, objects=after.objects[1:]))
