"""The numbers on the page about the method match the code."""

import inspect
import re
import sys
from pathlib import Path

import pytest

from slimsfm.domination import exact, random_greedy
from slimsfm.evaluation import scores
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.graph import GraphOptions
from slimsfm.localization import LocalizationOptions, calibration, evidence, round_result
from slimsfm.pose import RansacOptions
from slimsfm.reduction import DominatingSetOptions, forecast
from slimsfm.selection import information, problem

PAGE = " ".join((Path(__file__).parents[2] / "docs" / "method.md").read_text(encoding="utf-8").split())


def default(function, name: str) -> float:
    return inspect.signature(function).parameters[name].default


def test_the_weights_of_the_confidence_match_the_code():
    formula = PAGE[PAGE.index(r"\log \frac{c}{1 - c}") :].partition("$$")[0]
    constant, *rest = re.findall(r"[=+-] (\d\.\d+)", formula)
    assert [float(one) for one in (constant, *rest)] == calibration.EVIDENCE_WEIGHTS["sift"].tolist()


@pytest.mark.parametrize(
    ("words", "value"),
    [
        (r"\tau = {:g}", GraphOptions().threshold),
        (r"\tau = {:g}", DominatingSetOptions().threshold),
        ("probability that $e < {:g}$", ADD_FRACTIONS[0]),
        (r"c_t \ge {:g}", round_result.SURE),
        (r"\hat{{e}}_t \le {:g}", round_result.ACCURATE),
        (r"\hat{{e}}_t > {:g} \hat", round_result.SETTLED),
        ("$c < {:g}$ is discarded", LocalizationOptions().min_confidence),
        ("inliers within {:g} px", RansacOptions().max_error_px),
        (r"\sigma_0 = {:g}", problem.PRIOR_SIGMA),
        ("resampled with replacement, {:g} times", scores._RESAMPLES),
        ("the smallest of {:g} |", default(random_greedy, "draws")),
        ("Up to {:g} references", forecast._MOST_TESTS),
    ],
)
def test_a_number_matches_the_code(words, value):
    assert words.format(value) in PAGE


def test_numbers_in_words_match_the_code():
    assert evidence.UNAMBIGUOUS == 0.75  # three quarters of the inliers
    assert evidence.RIVAL_RANSAC.min_inliers == 6
    assert round_result.MIN_REFUTING == 2
    assert RansacOptions().min_inliers == 12
    assert default(exact, "time_limit_s") == 60  # a minute
    choosing = sys.modules[information.__module__]
    assert (choosing._WEIGHT, choosing._FIRST_COVER, choosing._GROWTH) == (0.5, 8, 1.25)
