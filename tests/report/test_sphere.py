"""Directions of cameras, equal-area maps of them, and their chart."""

from xml.etree import ElementTree

import numpy as np
import pytest
from charting import drawn, outcomes
from matplotlib.colors import to_hex

from slimsfm.geometry import Box
from slimsfm.report.figures import CHOSEN, figure_svg
from slimsfm.report.sphere import (
    angles_deg,
    fitting_projection,
    from_angles,
    lambert,
    mollweide,
    query_verdicts,
    sphere_chart,
    view_directions,
)
from slimsfm.synthetic.scene import look_at

BOX = Box(np.array([1.0, 2.0, 3.0]), np.diag([0.3, 0.2, 0.1]))
VERDICTS = ("right", "wrong", "not localized")


def camera_at(azimuth_deg, elevation_deg, distance=2.0):
    """A camera that looks at the center of the box, z up."""
    direction = from_angles(np.array([azimuth_deg]), np.array([elevation_deg]))[0]
    return look_at(BOX.center + distance * direction, BOX.center)


def references_at(*places):
    return {f"{k}.jpg": camera_at(*place) for k, place in enumerate(places)}


def test_directions_of_known_cameras_are_exact():
    front = [camera_at(azimuth, 0.0) for azimuth in (70.0, 100.0, 130.0)]  # azimuth 0 is in their middle
    asked = [(100.0, 0.0), (120.0, 40.0), (55.0, -20.0), (-90.0, 10.0)]
    found = angles_deg(view_directions([camera_at(*place, 5.0) for place in asked], BOX, front))
    np.testing.assert_allclose(found, [[0, 0], [20, 40], [-45, -20], [170, 10]], atol=1e-9)
    nearer = view_directions([camera_at(*place, 2.0) for place in asked], BOX, front)
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


def test_maps_show_the_sphere_from_outside():
    front, right, top = from_angles(np.array([0.0, 90.0, 0.0]), np.array([0.0, 0.0, 90.0]))
    up = np.array([0.0, 0.0, 1.0])
    places = lambert(np.stack([front, right, top]), up)
    np.testing.assert_allclose(places, [[0, -np.sqrt(2)], [np.sqrt(2), 0], [0, 0]], atol=1e-12)
    ahead = lambert(np.stack([front, right, top]), front)
    np.testing.assert_allclose(ahead, [[0, 0], [np.sqrt(2), 0], [0, np.sqrt(2)]], atol=1e-12)
    flat = mollweide(np.stack([front, right, top]))
    np.testing.assert_allclose(flat, [[0, 0], [np.sqrt(2), 0], [0, np.sqrt(2)]], atol=1e-6)


def test_the_projection_depends_on_where_the_cameras_are():
    around = from_angles(np.arange(0, 360, 20.0), np.full(18, 30.0))
    assert fitting_projection(around).is_from_above
    assert fitting_projection(around).reach_deg == 75
    ahead = fitting_projection(from_angles(np.array([-40.0, 0.0, 40.0]), np.zeros(3)))
    np.testing.assert_allclose(ahead.middle, [1, 0, 0], atol=1e-12)
    assert ahead.reach_deg == 45
    everywhere = fitting_projection(np.concatenate([around, -around, [[0.0, 0.0, -1.0]]]))
    assert everywhere.middle is None


def test_the_sphere_shows_which_queries_fail_before_and_after():
    references = references_at((-30.0, 20.0), (0.0, 20.0), (30.0, 20.0), (0.0, 50.0))
    poses = list(references.values())
    queries = [camera_at(*place) for place in [(-20.0, 30.0), (10.0, 10.0), (25.0, 40.0), (5.0, 35.0)]]
    before = ["right", "right", "wrong", "not localized"]
    after = ["wrong", "right", "not localized", "right"]
    seen, asked = (view_directions(some, BOX, poses) for some in (poses, queries))
    projection = fitting_projection(np.concatenate([seen, asked]))
    figure = sphere_chart(BOX, references, ["0.jpg", "2.jpg"], queries, (before, after))
    full, reduced = figure.axes
    for axes, verdicts in ((full, before), (reduced, after)):
        for verdict in VERDICTS:
            expected = projection.apply(asked[[one == verdict for one in verdicts]])
            np.testing.assert_allclose(drawn(axes, verdict), [expected])
    np.testing.assert_allclose(drawn(full, "kept"), [projection.apply(seen)])
    assert drawn(full, "dropped") == [[]]
    np.testing.assert_allclose(drawn(reduced, "kept"), [projection.apply(seen[::2])])
    np.testing.assert_allclose(drawn(reduced, "dropped"), [projection.apply(seen[1::2])])
    said = [axes.get_title(loc="left") for axes in (full, reduced)]
    assert said[0] == "Full map: 4 images\nqueries: 2 right, 1 wrong, 1 not localized"
    assert said[1] == "Reduced map: 2 images\nqueries: 2 right, 1 wrong, 1 not localized"
    kept = [line for line in reduced.get_lines() if line.get_label() == "kept"]
    assert {to_hex(line.get_color()) for line in kept} == {CHOSEN}


@pytest.mark.parametrize("turned", [0.0, 180.0])
def test_spheres_are_drawn_completely_without_queries_and_with_cameras_everywhere(turned):
    references = references_at(*((azimuth + turned, 80.0 - azimuth / 2) for azimuth in range(0, 320, 20)))
    figure = sphere_chart(BOX, references, list(references), [], ([], []))
    for axes in figure.axes:
        rim_x, rim_y = (abs(np.array(limits)).max() for limits in (axes.get_xlim(), axes.get_ylim()))
        for line in axes.get_lines():
            x, y = line.get_data()
            assert not len(x) or (np.nanmax(np.abs(x)) <= rim_x and np.nanmax(np.abs(y)) <= rim_y)
    ElementTree.fromstring(figure_svg(figure))


def test_queries_are_judged_by_a_tenth_of_the_diagonal():
    assert query_verdicts(outcomes([0.09, 0.1, np.inf], [1.0, 1.0, np.nan])) == list(VERDICTS)


def test_a_chart_without_references_or_with_missing_verdicts_is_refused():
    with pytest.raises(ValueError, match="references"):
        sphere_chart(BOX, {}, [], [], ([], []))
    with pytest.raises(ValueError, match="verdicts"):
        sphere_chart(BOX, references_at((0.0, 0.0)), [], [camera_at(0.0, 0.0)], (["right"], []))
