"""The numbers of the page on the method are those of the code."""

import inspect
import re
import sys
from pathlib import Path

import pytest

from slimsfm.domination import exact, random_greedy
from slimsfm.evaluation import statistics
from slimsfm.graph import GraphOptions
from slimsfm.localization import LocalizationOptions, search, verification
from slimsfm.pose import RansacOptions
from slimsfm.reduction import DominatingSetOptions, forecast
from slimsfm.selection import information, problem

PAGE = " ".join((Path(__file__).parents[2] / "docs" / "method.md").read_text(encoding="utf-8").split())


def default(function, name: str) -> float:
    return inspect.signature(function).parameters[name].default


def test_the_weights_of_the_confidence_are_those_learned():
    formula = PAGE[PAGE.index(r"\log \frac{c}{1 - c}") :].partition("$$")[0]
    constant, *rest = re.findall(r"[=+-] (\d\.\d+)", formula)
    assert [float(one) for one in (constant, *rest)] == verification.WEIGHTS.tolist()


@pytest.mark.parametrize(
    ("words", "value"),
    [
        (r"\tau = {:g}", GraphOptions().threshold),
        (r"\tau = {:g}", DominatingSetOptions().threshold),
        ("probability that $e < {:g}$", verification.RIGHT),
        (r"c_t \ge {:g}", search._SURE),
        (r"\hat{{e}}_t \le {:g}", search._EXACT),
        (r"\hat{{e}}_t > {:g} \hat", search._SETTLED),
        ("$c < {:g}$ is not given", LocalizationOptions().min_confidence),
        ("inliers within {:g} px", RansacOptions().max_error_px),
        (r"\sigma_0 = {:g}", problem.PRIOR_SIGMA),
        ("anew, with replacement, {:g} times", statistics._RESAMPLES),
        ("the smallest of {:g} |", default(random_greedy, "draws")),
        ("Up to {:g} references", forecast._MOST_TESTS),
    ],
)
def test_a_number_is_the_code_s(words, value):
    assert words.format(value) in PAGE


def test_what_is_said_in_words_is_so_too():
    assert verification._CLEAR == 0.75  # three quarters of the inliers
    assert verification._RIVAL.min_inliers == 6
    assert search._REFUTING == 2
    assert RansacOptions().min_inliers == 12
    assert default(exact, "time_limit_s") == 60  # a minute
    choosing = sys.modules[information.__module__]
    assert (choosing._WEIGHT, choosing._FIRST_COVER, choosing._GROWTH) == (0.5, 8, 1.25)
