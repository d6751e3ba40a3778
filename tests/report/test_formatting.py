from dataclasses import replace

import numpy as np
import pytest

from slimsfm.evaluation.comparison import Comparison
from slimsfm.evaluation.results import MappedObject
from slimsfm.evaluation.scores import Interval
from slimsfm.report.formatting import (
    format_count,
    format_difference,
    format_dominating_set,
    format_error,
    format_gain,
    format_line,
    format_map,
    format_ratio,
)

COMPARISON = Comparison(
    object="can",
    before=("sift", "exhaustive", "full"),
    after=("sift", "direct", "default"),
    queries=30,
    add_before=98.0,
    add_after=97.0,
    add_gain=Interval(-2.5, 0.0),
    p_value=0.4,
    faster=14.2,
    faster_whole=3.0,
    faster_between=Interval(13.0, 15.0),
    smaller=860.3,
)
MAPPED = MappedObject(
    method="sift",
    references=60,
    points=5000,
    edges=900,
    dominating_set=("1.png", "2.png"),
    lower_bound=2,
    dominating_points=1565,
)
TIMES = "\N{MULTIPLICATION SIGN}"


def test_counts_have_plurals():
    assert [format_count(1, "query"), format_count(1234, "query"), format_count(0, "image")] == [
        "1 query",
        "1,234 queries",
        "0 images",
    ]


def test_a_map_is_described_by_its_counts(full, reduced):
    assert format_map(full) == "4 images, 30 points"
    assert format_map(reduced) == "1 image, 20 points"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (14.2, f"14{TIMES} faster"),
        (1.52, f"1.5{TIMES} faster"),
        (0.5, f"2.0{TIMES} slower"),
        (0.98, "equally fast"),
    ],
)
def test_ratios_name_their_direction(value, text):
    assert format_ratio(value, "faster", "slower") == text


def test_a_gain_includes_its_cost():
    assert format_gain(COMPARISON) == f"860{TIMES} smaller, 14{TIMES} faster; ADD-0.1d 98.0 % → 97.0 %"
    assert "2.0" in format_gain(replace(COMPARISON, faster=0.5))
    assert format_difference(COMPARISON) == "difference \N{MINUS SIGN}2.5 to +0.0 points, p 0.400"


def test_lines_name_their_method_if_there_are_several():
    assert format_line(COMPARISON.after, ["sift"]) == "default map, direct"
    assert format_line(COMPARISON.after, ["sift", "aliked"]) == "default map, direct, with sift"


def test_a_dominating_set_is_described_with_its_lower_bound():
    assert format_dominating_set(MAPPED) == (
        "2 of 60 images dominate the others (no smaller set can) and see 1,565 of 5,000 points."
    )
    assert "(at least 1 must)" in format_dominating_set(replace(MAPPED, lower_bound=1))


def test_an_error_without_a_pose_is_not_a_number():
    assert format_error(np.inf) == "not localized"
    assert format_error(0.0213).replace("\N{NO-BREAK SPACE}", " ") == "2.1 % of d"
