"""Charts of accuracy over size and time: what is drawn, not how it looks."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from charting import drawn, texts

from candidates import FULL, candidate, frontier_of
from slimsfm.evaluation.scores import Interval, Scores
from slimsfm.evaluation.table import Row
from slimsfm.localization import Seconds
from slimsfm.report.figures import figure_svg
from slimsfm.report.tradeoffs import curves_figure, frontier_chart, pareto_front


def row(strategy, variant, *, size, add, ms, method="sift", interval=None):
    scores = Scores(
        queries=20,
        localized=100.0,
        add={0.1: add, 0.05: add, 0.02: add},
        median_error=0.01,
        deg_cm=None,
        confidence_wrong=None,
        references_tried=3.0,
        seconds=Seconds(extract=20e-3, match=0.75e-3 * ms, pose=0.25e-3 * ms),
    )
    intervals = {"add_0.1d": Interval(*interval)} if interval else {}
    names = {"object": "can", "method": method, "strategy": strategy, "variant": variant}
    return Row(**names, references=3.0, points=9.0, map_bytes=size, scores=scores, intervals=intervals)


ROWS = (
    row("exhaustive", "full", size=1e7, add=99.0, ms=1000.0, interval=(95.0, 100.0)),
    row("exhaustive", "dominating", size=1e6, add=97.0, ms=90.0),
    row("direct", "full", size=1e7, add=95.0, ms=20.0),
    row("direct", "default", size=5e4, add=96.0, ms=4.0, interval=(90.0, 98.0)),
    row("exhaustive", "random", size=1e6, add=80.0, ms=90.0),
)


@pytest.mark.parametrize(
    ("costs", "gains", "front"),
    [
        ([1], [5], [0]),
        ([1, 2, 3], [5, 4, 6], [0, 2]),
        ([3, 1, 2], [7, 7, 7], [1]),
        ([2, 2, 1], [5, 9, 1], [2, 1]),
        ([1, 1, 1], [4, 4, 4], [0]),
    ],
)
def test_the_front_is_what_no_entry_beats(costs, gains, front):
    assert pareto_front([*map(float, costs)], [*map(float, gains)]) == front


def test_the_front_is_by_definition():
    rng = np.random.default_rng(0)
    for _ in range(50):
        costs, gains = rng.integers(0, 6, (2, 12)).astype(float).tolist()
        beaten = [
            any(
                (costs[j], -gains[j]) != (costs[i], -gains[i])
                and costs[j] <= costs[i]
                and gains[j] >= gains[i]
                for j in range(12)
            )
            for i in range(12)
        ]
        unbeaten = {(costs[i], gains[i]) for i in range(12) if not beaten[i]}
        front = [(costs[i], gains[i]) for i in pareto_front(costs, gains)]
        assert set(front) == unbeaten
        assert front == sorted(unbeaten)


def test_each_row_is_a_mark_at_its_size_time_and_accuracy():
    by_size, by_time = frontier_chart(ROWS).axes
    for one in ROWS:
        name = f"{one.strategy}, {one.variant}"
        ms = 1e3 * one.scores.seconds.total
        np.testing.assert_allclose(drawn(by_size, name), [[[one.map_bytes, one.scores.add[0.1]]]])
        np.testing.assert_allclose(drawn(by_time, name), [[[ms, one.scores.add[0.1]]]])
    np.testing.assert_allclose(drawn(by_size, "front"), [[[5e4, 96], [1e6, 97], [1e7, 99]]])
    np.testing.assert_allclose(drawn(by_time, "front"), [[[24, 96], [110, 97], [1020, 99]]])
    assert (by_size.get_xscale(), by_time.get_xscale()) == ("log", "log")


def test_available_intervals_are_drawn():
    by_size, _ = frontier_chart(ROWS).axes
    upright = [line.get_xydata().tolist() for line in by_size.get_lines() if len(line.get_xydata()) == 2]
    assert upright == [[[1e7, 95], [1e7, 100]], [[5e4, 90], [5e4, 98]]]
    low, high = by_size.get_ylim()
    assert low < 80
    assert high > 100


def test_only_the_front_is_labeled_and_labels_do_not_overlap():
    figure = frontier_chart(ROWS)
    renderer = figure.canvas.get_renderer() if hasattr(figure.canvas, "get_renderer") else None
    for axes in figure.axes:
        assert sorted(texts(axes)) == ["direct, default", "exhaustive, dominating", "exhaustive, full"]
        boxes = [text.get_window_extent(renderer) for text in axes.texts]
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
        assert all(axes.get_window_extent().padded(1).containsx(box.x0) for box in boxes)


def test_labels_without_space_are_omitted():
    crowd = [
        row("direct", f"points:{k}", size=1e3 + k, add=90 + 0.01 * k, ms=5 + 0.01 * k) for k in range(40)
    ]
    figure = frontier_chart(crowd)
    assert 0 < len(figure.axes[0].texts) < 40


def test_the_legend_names_strategies_maps_and_several_methods():
    rows = [*ROWS, row("direct", "points:500", size=1e5, add=90.0, ms=5.0, method="a$b$+c")]
    (legend,) = frontier_chart(rows).legends
    said = [text.get_text() for text in legend.get_texts()]
    maps = ["full", "dominating", "default", "random", "points:500"]
    assert said == ["strategy", "exhaustive", "direct", "map", *maps, "method", "sift", "a$b$+c"]
    (alone,) = frontier_chart(ROWS).legends
    assert "method" not in [text.get_text() for text in alone.get_texts()]


def test_a_chart_without_rows_is_refused():
    with pytest.raises(ValueError, match="rows"):
        frontier_chart([])


def test_a_single_row_is_drawn():
    by_size, by_time = frontier_chart([row("direct", "full", size=1e6, add=0.0, ms=0.0)]).axes
    assert drawn(by_size, "front") == [[[1e6, 0.0]]]
    assert by_time.get_xlim()[0] > 0


DIRECT = "kcover, direct"


def rings(axes):
    return [
        place
        for line in axes.get_lines()
        if line.get_markersize() > 10
        for place in line.get_xydata().tolist()
    ]


def test_each_candidate_is_drawn_at_its_size_time_and_change():
    candidates = [
        candidate(size=4000, missed=0, ms=100.0),
        candidate(size=1000, missed=4, ms=1.0),
        candidate(size=2000, missed=2, ms=10.0),
    ]
    by_size, by_time = curves_figure(frontier_of(*candidates), {"direct": candidates[2]}, 10_000).axes
    assert drawn(by_size, DIRECT) == [[[4000, 0]], [[1000, -20]], [[2000, -10]]]
    times = np.array(drawn(by_time, DIRECT))
    np.testing.assert_allclose(times, [[[100, 0]], [[1, -20]], [[10, -10]]])
    assert drawn(by_size, "front") == [[[1000, -20], [2000, -10], [4000, 0]]]
    assert rings(by_size) == [[2000, -10]]
    np.testing.assert_allclose(rings(by_time), [[10, -10]])
    assert (by_size.get_xscale(), by_size.get_yscale(), by_time.get_xscale()) == ("log", "linear", "log")
    low, high = by_size.get_xlim()
    assert low < 1000
    assert high > 10_000


def test_colors_are_methods_and_markers_are_uses():
    candidates = [
        candidate(use=use, method=method) for use in ("images", "direct") for method in ("kcover", "a$b$<c")
    ]
    figure = curves_figure(frontier_of(*candidates), {"direct": candidates[2]}, 10_000)
    (legend,) = figure.legends
    named = [text.get_text() for text in legend.get_texts()]
    assert named == ["method", "kcover", "a$b$<c", "use", "images", "direct", "recommended", "full map"]
    names = [f"{one.choice.method}, {one.choice.use}" for one in candidates]
    for axes in figure.axes:
        assert all(len(drawn(axes, name)) == 1 for name in names)
        looks = {
            (line.get_color(), line.get_marker()) for line in axes.get_lines() if line.get_label() in names
        }
        assert len(looks) == 4
        assert len(rings(axes)) == 1


def test_a_single_candidate_and_one_without_measurements_are_drawn():
    lone = candidate(missed=-2)
    nothing = replace(lone.prediction.of(()), seconds=Seconds(extract=float("nan"), match=0.0, pose=0.0))
    unmeasured = replace(lone, prediction=nothing, full=FULL.of(()))
    for candidates in ([lone], [unmeasured], [lone, unmeasured]):
        svg = figure_svg(curves_figure(frontier_of(*candidates), {"direct": candidates[0]}, 10_000))
        ElementTree.fromstring(svg)
        assert "nan" not in svg.lower()
        assert ">inf" not in svg.lower()


def test_equal_frontiers_are_drawn_equally():
    candidates = [
        candidate(size=one, method=method) for one in (5, 70) for method in ("kcover", "information")
    ]
    first, second = (figure_svg(curves_figure(frontier_of(*candidates), {}, 900)) for _ in range(2))
    assert first == second
