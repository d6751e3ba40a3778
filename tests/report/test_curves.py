"""Curves of a frontier, made of candidates by hand."""

from dataclasses import replace
from itertools import pairwise
from xml.etree import ElementTree

import pytest

from candidates import FULL, candidate, frontier_of
from slimsfm.report.curves import draw_curves

SVG = "{http://www.w3.org/2000/svg}"


def dots(curves):
    """Places of the candidates in each of the charts."""
    charts = ElementTree.fromstring(curves).findall(f"{SVG}g")
    return [
        [
            (float(one.get("cx")), float(one.get("cy")))
            for one in chart.iter(f"{SVG}circle")
            if one.get("r") == "2.5"
        ]
        for chart in charts
    ]


def test_larger_is_further_right_and_worse_is_higher():
    ways = [
        candidate(size=1000, missed=4, ms=1.0),
        candidate(size=2000, missed=2, ms=10.0),
        candidate(size=4000, missed=0, ms=100.0),
    ]
    losses, times = dots(draw_curves(frontier_of(*ways), {"direct": ways[1]}, 10_000))
    assert losses == sorted(losses)
    assert [y for _, y in losses] == sorted(y for _, y in losses)  # down the page, as losses fall
    assert [y for _, y in times] == sorted((y for _, y in times), reverse=True)
    steps = [b[0] - a[0] for a, b in pairwise(losses)]
    assert steps[0] == pytest.approx(steps[1], abs=0.2)  # sizes are drawn by their ratio


def test_one_way_alone_and_one_that_nothing_could_be_measured_on_are_drawn():
    lone = candidate(missed=-2)
    untold = replace(lone, prediction=replace(lone.prediction.of(()), seconds=0.0), full=FULL.of(()))
    for ways in ([lone], [untold], [lone, untold]):
        curves = draw_curves(frontier_of(*ways), {"direct": ways[0]}, 10_000)
        assert [len(chart) for chart in dots(curves)] == [len(ways)] * 2
        assert "nan" not in curves
        assert "inf" not in curves


def test_equal_frontiers_are_drawn_equally():
    ways = [candidate(size=one, method=method) for one in (5, 70) for method in ("kcover", "a<b")]
    drawn = [draw_curves(frontier_of(*order), {}, 900) for order in (ways, ways)]
    assert drawn[0] == drawn[1]
    assert "a&lt;b" in drawn[0]
