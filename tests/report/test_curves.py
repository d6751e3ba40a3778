"""Curves of a frontier, made of candidates by hand."""

from dataclasses import replace
from xml.etree import ElementTree

import pytest
from slimsfm.report.curves import curves_figure

from candidates import FULL, candidate, frontier_of
from slimsfm.report.figures import figure_svg

DIRECT = "direct: kcover"


def drawn(axes, label):
    """The places that the curves of a label go through."""
    return [line.get_xydata().tolist() for line in axes.get_lines() if line.get_label() == label]


def rings(axes):
    return [
        place
        for line in axes.get_lines()
        if line.get_markersize() > 10
        for place in line.get_xydata().tolist()
    ]


def test_each_way_is_drawn_at_its_size_loss_and_time():
    ways = [
        candidate(size=4000, missed=0, ms=100.0),
        candidate(size=1000, missed=4, ms=1.0),
        candidate(size=2000, missed=2, ms=10.0),
    ]
    losses, times = curves_figure(frontier_of(*ways), {"direct": ways[2]}, 10_000).axes
    assert drawn(losses, DIRECT) == [[[1000, 20], [2000, 10], [4000, 0]]]
    assert drawn(times, DIRECT) == [[[1000, pytest.approx(1)], [2000, pytest.approx(10)], [4000, 100]]]
    assert (rings(losses), rings(times)) == ([[2000, 10]], [[2000, pytest.approx(10)]])
    assert (losses.get_xscale(), losses.get_yscale(), times.get_yscale()) == ("log", "linear", "log")
    for axes in (losses, times):
        low, high = axes.get_xlim()
        assert low < 1000
        assert high > 10_000


def test_each_use_and_method_has_a_curve_of_its_own():
    ways = [
        candidate(use=use, method=method) for use in ("images", "direct") for method in ("kcover", "a$b$<c")
    ]
    figure = curves_figure(frontier_of(*ways), {}, 10_000)
    (legend,) = figure.legends
    names = ["direct: a$b$<c", DIRECT, "images: a$b$<c", "images: kcover"]
    assert [text.get_text() for text in legend.get_texts()] == [*names, "full map", "recommended"]
    for axes in figure.axes:
        assert all(len(drawn(axes, name)) == 1 for name in names)
        assert len({line.get_color() for line in axes.get_lines() if line.get_label() in names}) == 4
        assert not rings(axes)


def test_one_way_alone_and_one_that_nothing_could_be_measured_on_are_drawn():
    lone = candidate(missed=-2)
    untold = replace(lone, prediction=replace(lone.prediction.of(()), seconds=0.0), full=FULL.of(()))
    for ways in ([lone], [untold], [lone, untold]):
        svg = figure_svg(curves_figure(frontier_of(*ways), {"direct": ways[0]}, 10_000))
        ElementTree.fromstring(svg)
        assert "nan" not in svg.lower()
        assert ">inf" not in svg.lower()


def test_equal_frontiers_are_drawn_equally():
    ways = [candidate(size=one, method=method) for one in (5, 70) for method in ("kcover", "information")]
    first, second = (figure_svg(curves_figure(frontier_of(*ways), {}, 900)) for _ in range(2))
    assert first == second
