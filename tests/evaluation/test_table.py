import json
from dataclasses import replace

import numpy as np
import pytest
from handmade import DOMINATING, FULL, measurement_like, result_like

from slimsfm.evaluation.table import BY_FRAME, BY_OBJECT, average_rows, mean_over_draws, rows_of

RANDOM = ("sift", "exhaustive", "random")
SHARES = {"localized", "add_0.1d", "add_0.05d", "add_0.02d"}
METRIC_SHARES = {"1deg_1cm", "3deg_3cm", "5deg_5cm"}
KEYS = {
    *("object", "method", "strategy", "variant", "references", "points", "map_bytes", "queries"),
    *SHARES,
    *("median_error", "confidence_wrong_at_0.9", "references_tried"),
    *("ms_extract", "ms_match", "ms_pose", "ms_total", "fps"),
}


def with_ends(shares):
    return shares | {f"{key}_{end}" for key in shares for end in ("low", "high")}


@pytest.mark.parametrize("unit", ["metre", "unknown"])
@pytest.mark.parametrize("errors", [[0.01, 0.03], [0.01, np.inf], [np.inf, np.inf]], ids=str)
def test_a_row_is_plain_json_with_the_documented_keys(unit, errors):
    (row,) = rows_of(result_like("toy", measurement_like(FULL, errors), unit=unit))
    values = json.loads(json.dumps(row.to_json(), allow_nan=False))
    shares = SHARES | METRIC_SHARES if unit == "metre" else SHARES
    assert values.keys() == KEYS | with_ends(shares | {"fps"})
    assert [values[key] for key in ("object", "method", "strategy", "variant")] == ["toy", *FULL]
    assert values["queries"] == 2
    assert values["ms_extract"] == pytest.approx(10.0)
    assert values["ms_match"] == pytest.approx(20.0)
    assert values["ms_pose"] == pytest.approx(5.0)
    assert values["ms_total"] == pytest.approx(35.0)
    assert values["fps"] == pytest.approx(1 / 0.035)


def test_a_row_counts_queries_in_percent():
    """Relative errors, also as meters, and times 100 as degrees."""
    (row,) = rows_of(result_like("toy", measurement_like(FULL, [0.001, 0.01, 0.025, 0.07, np.inf])))
    values = row.to_json()
    assert values["localized"] == 80.0
    assert [values[f"add_{fraction}d"] for fraction in ("0.1", "0.05", "0.02")] == [80.0, 60.0, 40.0]
    assert [values[f"{n}deg_{n}cm"] for n in (1, 3, 5)] == [40.0, 60.0, 60.0]
    assert values["median_error"] == 0.025
    assert (row.references, row.points, row.map_bytes) == (4.0, 100.0, 1000.0)


def test_an_infinite_median_has_no_value():
    def median(errors):
        return rows_of(result_like("toy", measurement_like(FULL, errors)))[0].to_json()["median_error"]

    assert median([np.inf, np.inf, 0.01]) is None
    assert median([0.01, 0.02, np.inf]) == 0.02


def test_rows_have_the_order_of_the_measurements():
    result = result_like("toy", measurement_like(DOMINATING, [0.1]), measurement_like(FULL, [0.1]))
    assert [row.variant for row in rows_of(result)] == ["dominating", "full"]


def test_intervals_contain_the_values():
    errors = np.random.default_rng(0).lognormal(-3, 1, 60)
    errors[::7] = np.inf
    seconds = np.random.default_rng(1).lognormal(-4, 1, (60, 3))
    cell = measurement_like(FULL, errors)
    cell.map_runs[0].outcomes.seconds[:] = seconds
    (row,) = rows_of(result_like("toy", cell))
    values = row.to_json()
    for key in SHARES | METRIC_SHARES | {"fps"}:
        assert values[f"{key}_low"] < values[key] < values[f"{key}_high"]
    assert values["fps"] == pytest.approx(1 / seconds.sum(axis=1).mean())


def test_intervals_are_narrow_if_all_queries_are_alike():
    (row,) = rows_of(result_like("toy", measurement_like(FULL, [0.01] * 9)))
    values = row.to_json()
    assert values["add_0.1d_low"] == values["add_0.1d_high"] == 100.0
    assert values["fps_low"] == pytest.approx(values["fps_high"])


def test_several_draws_are_averaged_into_one_row():
    draws = [[0.01, 0.01, np.inf], [0.01, np.inf, np.inf]]
    cell = measurement_like(RANDOM, *draws)
    (row,) = rows_of(result_like("toy", cell))
    assert row.scores.queries == 3
    assert row.scores.localized == pytest.approx(50.0)
    assert row.scores.add[0.1] == pytest.approx(50.0)
    assert mean_over_draws(cell, np.isfinite(cell.outcomes.error)).tolist() == [1.0, 0.5, 0.0]


def test_draws_do_not_increase_the_number_of_queries():
    """Five equal draws carry no more information than one: the interval keeps its width."""
    errors = [0.01, 0.01, 0.01, np.inf]
    (once,) = rows_of(result_like("toy", measurement_like(RANDOM, errors)))
    (often,) = rows_of(result_like("toy", measurement_like(RANDOM, *[errors] * 5)))
    assert often.intervals == once.intervals
    assert often.scores.queries == 4


def test_sizes_are_means_over_draws():
    first, second = (
        measurement_like(RANDOM, [0.1], points=50, map_bytes=10),
        measurement_like(RANDOM, [0.1], points=100),
    )
    both = replace(first, map_runs=first.map_runs + second.map_runs)
    (row,) = rows_of(result_like("toy", both))
    assert (row.references, row.points, row.map_bytes) == (4.0, 75.0, 505.0)


@pytest.fixture
def unequal():
    """An object with one of two queries correct, and an object with six of six."""
    few = measurement_like(
        FULL, [0.01, np.inf], seconds=(0.1, 0.2, 0.1), references=2, points=10, map_bytes=100
    )
    many = measurement_like(
        FULL, [0.03] * 6, seconds=(0.1, 0.05, 0.05), references=8, points=30, map_bytes=300
    )
    return [result_like("few", few), result_like("many", many)]


def test_by_frame_all_queries_have_equal_weights(unequal):
    by_frame = average_rows(unequal)[0]
    assert by_frame.object == BY_FRAME
    assert by_frame.scores.queries == 8
    assert by_frame.scores.add[0.1] == pytest.approx(100 * 7 / 8)
    assert by_frame.scores.add[0.02] == pytest.approx(100 / 8)
    assert by_frame.scores.median_error == pytest.approx(0.03)
    assert by_frame.scores.seconds.total == pytest.approx((2 * 0.4 + 6 * 0.2) / 8)


def test_by_object_all_objects_have_equal_weights(unequal):
    by_object = average_rows(unequal)[1]
    assert by_object.object == BY_OBJECT
    assert by_object.scores.queries == 8
    assert by_object.scores.add[0.1] == pytest.approx((50 + 100) / 2)
    assert by_object.scores.add[0.02] == pytest.approx((50 + 0) / 2)
    assert np.isinf(by_object.scores.median_error)  # between 0.03 and none
    assert by_object.scores.fps == pytest.approx(1 / 0.3)


def test_maps_are_averaged_over_objects_either_way(unequal):
    for row in average_rows(unequal):
        assert (row.references, row.points, row.map_bytes) == (5.0, 20.0, 200.0)


def test_intervals_of_averages_contain_the_averages_and_use_the_same_weights(unequal):
    """Only the two queries of one object vary: by frame they weigh a quarter, by object a half."""
    by_frame, by_object = (row.to_json() for row in average_rows(unequal))
    for row in (by_frame, by_object):
        assert row["add_0.1d_low"] <= row["add_0.1d"] <= row["add_0.1d_high"]
        assert row["fps_low"] <= row["fps"] * (1 + 1e-12)
        assert row["fps_high"] >= row["fps"] * (1 - 1e-12)
    assert (by_frame["add_0.1d_low"], by_frame["add_0.1d_high"]) == pytest.approx((75, 100))
    assert (by_object["add_0.1d_low"], by_object["add_0.1d_high"]) == pytest.approx((50, 100))


def test_averages_over_draws_count_each_query_once():
    objects = [
        result_like("few", measurement_like(RANDOM, [0.01, np.inf], [np.inf, np.inf])),
        result_like("many", measurement_like(RANDOM, [0.01] * 4, [0.01] * 4)),
    ]
    by_frame, by_object = average_rows(objects)
    assert by_frame.scores.queries == by_object.scores.queries == 6
    assert by_frame.scores.add[0.1] == pytest.approx(100 * 4.5 / 6)
    assert by_object.scores.add[0.1] == pytest.approx((25 + 100) / 2)


def test_a_row_is_averaged_over_the_objects_that_have_it(unequal):
    extra = measurement_like(DOMINATING, [0.01, 0.01])
    objects = [result_like("few", *unequal[0].measurements, extra), unequal[1]]
    rows = average_rows(objects)
    assert [(row.object, row.variant) for row in rows] == [
        (average, variant) for average in (BY_FRAME, BY_OBJECT) for variant in ("full", "dominating")
    ]
    assert [row.scores.queries for row in rows] == [8, 2, 8, 2]


def test_one_object_has_no_averages(unequal):
    assert average_rows(unequal[:1]) == []


def test_an_object_of_unknown_unit_removes_centimeters_from_averages(unequal):
    unknown = result_like("unknown", measurement_like(FULL, [0.01]), unit="unknown")
    assert all(row.scores.deg_cm is None for row in average_rows([*unequal, unknown]))
    assert all(row.scores.deg_cm is not None for row in average_rows(unequal))
