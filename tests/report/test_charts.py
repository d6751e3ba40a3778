"""Charts of a benchmark: not how they look but what is drawn."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pycolmap
import pytest
from matplotlib.colors import to_hex
from scipy.stats import binomtest
from slimsfm.report.charts import (
    QueryPlace,
    ReferencePlace,
    frontier_chart,
    query_places,
    reference_places,
    reliability_chart,
    sphere_chart,
)
from slimsfm.report.charts.calibration import calibration, wilson
from slimsfm.report.charts.directions import (
    angles_deg,
    directions,
    fitting_projection,
    from_angles,
    lambert,
    mollweide,
    verdicts,
)
from slimsfm.report.charts.frontier import pareto

from slimsfm.evaluation.outcomes import Outcomes
from slimsfm.evaluation.protocol import Query
from slimsfm.evaluation.scores import Scores
from slimsfm.evaluation.statistics import Interval
from slimsfm.evaluation.table import Row
from slimsfm.geometry import Box
from slimsfm.localization import Seconds
from slimsfm.report.figures import CHOSEN, figure_svg
from slimsfm.synthetic.trajectory import look_at

BOX = Box(np.array([1.0, 2.0, 3.0]), np.diag([0.3, 0.2, 0.1]))
VERDICTS = ("right", "wrong", "not localized")


def row(strategy, variant, *, size, add, ms, method="sift", interval=None):
    scores = Scores(
        queries=20,
        localized=100.0,
        add={0.1: add, 0.05: add, 0.02: add},
        median_error=0.01,
        deg_cm=None,
        confidence_wrong=None,
        references_tried=3.0,
        seconds=Seconds(extract=9.0, match=0.75e-3 * ms, pose=0.25e-3 * ms),
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


def drawn(axes, label):
    """What the lines of a label go through."""
    return [line.get_xydata().tolist() for line in axes.get_lines() if line.get_label() == label]


def texts(axes):
    return [text.get_text() for text in axes.texts]


def outcomes(errors, confidence):
    poses = [pycolmap.Rigid3d() if np.isfinite(error) else None for error in errors]
    n = len(errors)
    return Outcomes(
        error=np.array(errors, np.float64),
        rotation_deg=np.array(errors, np.float64),
        translation=np.array(errors, np.float64),
        confidence=np.array(confidence, np.float64),
        references=np.ones(n, np.int64),
        seconds=np.ones((n, 3)),
        cam_from_world=tuple(poses),
    )


def camera_at(azimuth_deg, elevation_deg, distance=2.0):
    """A camera that looks at the middle of the box, z up."""
    direction = from_angles(np.array([azimuth_deg]), np.array([elevation_deg]))[0]
    return look_at(BOX.center + distance * direction, BOX.center)


def references_at(*places):
    return [
        ReferencePlace(cam_from_world=camera_at(*place), kept=k % 2 == 0) for k, place in enumerate(places)
    ]


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
def test_the_front_is_what_nothing_beats(costs, gains, front):
    assert pareto([*map(float, costs)], [*map(float, gains)]) == front


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
        front = [(costs[i], gains[i]) for i in pareto(costs, gains)]
        assert set(front) == unbeaten
        assert front == sorted(unbeaten)


def test_every_line_of_the_table_is_a_mark_at_its_size_time_and_accuracy():
    by_size, by_time = frontier_chart(ROWS).axes
    for one in ROWS:
        name = f"sift {one.strategy} {one.variant}"
        ms = 1e3 * (one.scores.seconds.match + one.scores.seconds.pose)
        np.testing.assert_allclose(drawn(by_size, name), [[[one.map_bytes, one.scores.add[0.1]]]])
        np.testing.assert_allclose(drawn(by_time, name), [[[ms, one.scores.add[0.1]]]])
    np.testing.assert_allclose(drawn(by_size, "front"), [[[5e4, 96], [1e6, 97], [1e7, 99]]])
    np.testing.assert_allclose(drawn(by_time, "front"), [[[4, 96], [90, 97], [1000, 99]]])
    assert (by_size.get_xscale(), by_time.get_xscale()) == ("log", "log")


def test_intervals_are_drawn_where_there_are_some():
    by_size, _ = frontier_chart(ROWS).axes
    upright = [line.get_xydata().tolist() for line in by_size.get_lines() if len(line.get_xydata()) == 2]
    assert upright == [[[1e7, 95], [1e7, 100]], [[5e4, 90], [5e4, 98]]]
    low, high = by_size.get_ylim()
    assert low < 80
    assert high > 100


def test_just_the_front_is_labelled_and_no_label_covers_another():
    figure = frontier_chart(ROWS)
    renderer = figure.canvas.get_renderer() if hasattr(figure.canvas, "get_renderer") else None
    for axes in figure.axes:
        assert sorted(texts(axes)) == ["direct, default", "exhaustive, dominating", "exhaustive, full"]
        boxes = [text.get_window_extent(renderer) for text in axes.texts]
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
        assert all(axes.get_window_extent().padded(1).containsx(box.x0) for box in boxes)


def test_many_equal_lines_leave_out_labels_instead_of_piling_them_up():
    crowd = [
        row("direct", f"points:{k}", size=1e3 + k, add=90 + 0.01 * k, ms=5 + 0.01 * k) for k in range(40)
    ]
    figure = frontier_chart(crowd)
    assert 0 < len(figure.axes[0].texts) < 40


def test_the_legend_tells_strategies_maps_and_several_methods():
    rows = [*ROWS, row("direct", "points:500", size=1e5, add=90.0, ms=5.0, method="a$b$+c")]
    (legend,) = frontier_chart(rows).legends
    said = [text.get_text() for text in legend.get_texts()]
    maps = ["full", "dominating", "default", "random", "points:500"]
    assert said == ["strategy", "exhaustive", "direct", "map", *maps, "method", "sift", "a$b$+c"]
    (alone,) = frontier_chart(ROWS).legends
    assert "method" not in [text.get_text() for text in alone.get_texts()]


def test_a_chart_of_nothing_is_refused():
    with pytest.raises(ValueError, match="rows"):
        frontier_chart([])
    with pytest.raises(ValueError, match="references"):
        sphere_chart(BOX, [], [])


def test_one_line_alone_is_drawn():
    by_size, by_time = frontier_chart([row("direct", "full", size=1e6, add=0.0, ms=0.0)]).axes
    assert drawn(by_size, "front") == [[[1e6, 0.0]]]
    assert by_time.get_xlim()[0] > 0


SOME = outcomes(
    errors=[0.01, 0.02, 0.03, 0.2, 0.05, 0.5, np.inf],
    confidence=[0.95, 0.95, 0.95, 0.95, 0.55, 0.55, np.nan],
)


def test_calibration_is_what_a_hand_computes():
    found = calibration(SOME)
    assert found.counts.tolist() == [0, 0, 0, 0, 0, 2, 0, 0, 0, 4]
    assert (found.poses, found.without) == (6, 1)
    assert found.right[[5, 9]].tolist() == [0.5, 0.75]
    np.testing.assert_allclose(found.confidence[[5, 9]], [0.55, 0.95])
    assert np.isnan(found.right[0])
    assert found.expected_error == pytest.approx((4 * 0.2 + 2 * 0.05) / 6)
    assert found.brier == pytest.approx((3 * 0.05**2 + 0.95**2 + 0.45**2 + 0.55**2) / 6)


def test_a_pose_off_by_a_tenth_is_wrong_and_ends_of_the_scale_are_in_bins():
    found = calibration(outcomes([0.1, 0.0999], [0.0, 1.0]))
    assert found.counts.tolist() == [1, *[0] * 8, 1]
    assert found.right[[0, 9]].tolist() == [0.0, 1.0]
    assert (found.expected_error, found.brier) == (0.0, 0.0)


@pytest.mark.parametrize(("right", "count"), [(0, 1), (3, 4), (7, 7), (41, 60)])
def test_intervals_are_wilsons(right, count):
    expected = binomtest(right, count).proportion_ci(method="wilson")
    low, high = wilson(np.array([right / count]), np.array([count]))
    assert (low[0], high[0]) == (pytest.approx(expected.low, abs=1e-12), pytest.approx(expected.high))


def test_the_reliability_chart_shows_the_calibration():
    shares, counts = reliability_chart(SOME).axes
    assert drawn(shares, "as it says") == [[[0, 0], [1, 1]]]
    (bars,) = shares.containers
    np.testing.assert_allclose(bars.lines[0].get_xydata(), [[0.55, 0.5], [0.95, 0.75]])
    found = calibration(SOME)
    ends = [segment[:, 1] for segment in bars.lines[2][0].get_segments()]
    np.testing.assert_allclose(ends, np.stack([found.low, found.high], axis=1)[[5, 9]])
    assert [bar.get_height() for bar in counts.patches] == found.counts.tolist()
    assert [text for text in texts(counts) if text] == ["2", "4"]
    said = shares.get_title(loc="left")
    for words in ("6 poses, 1 query without", "calibration error 0.150", f"Brier score {found.brier:.3f}"):
        assert words in said


def test_a_reliability_chart_without_poses_says_so():
    shares, _ = reliability_chart(outcomes([np.inf] * 2, [np.nan] * 2)).axes
    assert shares.get_title(loc="left") == "0 poses, 2 queries without"


def test_directions_of_known_cameras_are_exact():
    front = [camera_at(azimuth, 0.0) for azimuth in (70.0, 100.0, 130.0)]  # azimuth 0 is in their middle
    asked = [(100.0, 0.0), (120.0, 40.0), (55.0, -20.0), (-90.0, 10.0)]
    found = angles_deg(directions([camera_at(*place, 5.0) for place in asked], BOX, front))
    np.testing.assert_allclose(found, [[0, 0], [20, 40], [-45, -20], [170, 10]], atol=1e-9)
    nearer = directions([camera_at(*place, 2.0) for place in asked], BOX, front)
    np.testing.assert_allclose(from_angles(*found.T), nearer, atol=1e-9)


@pytest.mark.parametrize("middle", [None, (0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
def test_projections_keep_areas(middle):
    rng = np.random.default_rng(0)
    azimuth, elevation, step = rng.uniform(-150, 150, 200), rng.uniform(-75, 75, 200), 1e-3

    def project(azimuth, elevation):
        points = from_angles(azimuth, elevation)
        return mollweide(points) if middle is None else lambert(points, np.array(middle))

    east = project(azimuth + step, elevation) - project(azimuth - step, elevation)
    north = project(azimuth, elevation + step) - project(azimuth, elevation - step)
    areas = east[:, 0] * north[:, 1] - east[:, 1] * north[:, 0]
    true = np.cos(np.radians(elevation)) * np.radians(2 * step) ** 2
    np.testing.assert_allclose(areas / true, 1, atol=2e-3)


def test_maps_are_oriented_as_one_sees_them_from_outside():
    front, right, top = from_angles(np.array([0.0, 90.0, 0.0]), np.array([0.0, 0.0, 90.0]))
    up = np.array([0.0, 0.0, 1.0])
    places = lambert(np.stack([front, right, top]), up)
    np.testing.assert_allclose(places, [[0, -np.sqrt(2)], [np.sqrt(2), 0], [0, 0]], atol=1e-12)
    ahead = lambert(np.stack([front, right, top]), front)
    np.testing.assert_allclose(ahead, [[0, 0], [np.sqrt(2), 0], [0, np.sqrt(2)]], atol=1e-12)
    flat = mollweide(np.stack([front, right, top]))
    np.testing.assert_allclose(flat, [[0, 0], [np.sqrt(2), 0], [0, np.sqrt(2)]], atol=1e-6)


def test_the_map_is_chosen_by_where_the_cameras_are():
    around = from_angles(np.arange(0, 360, 20.0), np.full(18, 30.0))
    assert fitting_projection(around).is_from_above
    assert fitting_projection(around).reach_deg == 75
    ahead = fitting_projection(from_angles(np.array([-40.0, 0.0, 40.0]), np.zeros(3)))
    np.testing.assert_allclose(ahead.middle, [1, 0, 0], atol=1e-12)
    assert ahead.reach_deg == 45
    everywhere = fitting_projection(np.concatenate([around, -around, [[0.0, 0.0, -1.0]]]))
    assert everywhere.middle is None


def test_the_sphere_shows_who_fails_before_and_after():
    references = references_at((-30.0, 20.0), (0.0, 20.0), (30.0, 20.0), (0.0, 50.0))
    places = [(-20.0, 30.0), (10.0, 10.0), (25.0, 40.0), (5.0, 35.0)]
    found = [("right", "wrong"), ("right", "right"), ("wrong", "not localized"), ("not localized", "right")]
    queries = [
        QueryPlace(cam_from_world=camera_at(*place), before=before, after=after)
        for place, (before, after) in zip(places, found, strict=True)
    ]
    poses = [one.cam_from_world for one in references]
    seen, asked = (
        directions([one.cam_from_world for one in some], BOX, poses) for some in (references, queries)
    )
    projection = fitting_projection(np.concatenate([seen, asked]))
    full, reduced = sphere_chart(BOX, references, queries).axes
    for axes, verdict_of in ((full, lambda one: one.before), (reduced, lambda one: one.after)):
        for verdict in VERDICTS:
            expected = projection.apply(asked[[verdict_of(one) == verdict for one in queries]])
            np.testing.assert_allclose(drawn(axes, verdict), [expected])
    np.testing.assert_allclose(drawn(full, "kept"), [projection.apply(seen)])
    assert drawn(full, "dropped") == [[]]
    np.testing.assert_allclose(drawn(reduced, "kept"), [projection.apply(seen[::2])])
    np.testing.assert_allclose(drawn(reduced, "dropped"), [projection.apply(seen[1::2])])
    said = [axes.get_title(loc="left") for axes in (full, reduced)]
    assert said[0] == "Full map: 4 images\nqueries: 2 right, 1 wrong, 1 not localized"
    assert said[1] == "Reduced map: 2 images\nqueries: 2 right, 1 wrong, 1 not localized"
    assert {to_hex(line.get_color()) for line in reduced.get_lines() if line.get_label() == "kept"} == {
        CHOSEN
    }


@pytest.mark.parametrize("turned", [0.0, 180.0])
def test_spheres_are_drawn_whole_without_queries_and_with_cameras_everywhere(turned):
    references = references_at(*((azimuth + turned, 80.0 - azimuth / 2) for azimuth in range(0, 320, 20)))
    figure = sphere_chart(BOX, references, [])
    for axes in figure.axes:
        (rim_x, rim_y), room = (
            (abs(np.array(limits)).max() for limits in (axes.get_xlim(), axes.get_ylim())),
            0,
        )
        for line in axes.get_lines():
            x, y = line.get_data()
            assert not len(x) or (
                np.nanmax(np.abs(x)) <= rim_x + room and np.nanmax(np.abs(y)) <= rim_y + room
            )
    ElementTree.fromstring(figure_svg(figure))


def test_queries_are_judged_by_a_tenth_of_the_diagonal(full, reduced):
    found = outcomes([0.09, 0.1, np.inf], [1.0, 1.0, np.nan])
    assert verdicts(found) == list(VERDICTS)
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480)
    asked = [
        Query(path=Path("q.png"), camera=camera, cam_from_world=camera_at(azimuth, 0.0))
        for azimuth in (0, 1, 2)
    ]
    places = query_places(asked, found, found)
    assert [(one.before, one.after) for one in places] == [(one, one) for one in VERDICTS]
    with pytest.raises(ValueError, match="zip"):
        query_places(asked[:2], found, found)
    assert [one.kept for one in reference_places(full, reduced)] == [False, True, False, False]
