"""Where on the viewing sphere queries fail, before and after a map was reduced."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from slimsfm.arrays import Mask, Points2D
from slimsfm.geometry import Box
from slimsfm.report.charts.directions import (
    Projection,
    QueryPlace,
    ReferencePlace,
    Verdict,
    directions,
    fitting_projection,
    from_angles,
)
from slimsfm.report.figures import CHOSEN, DROPPED, INK, new_figure, styled
from slimsfm.report.formatting import plural

_RIGHT = "#12873a"
_LOOKS: dict[Verdict, dict] = {
    "right": {"marker": "o", "ms": 4.5, "color": _RIGHT, "mec": "none"},
    "wrong": {"marker": "x", "ms": 7, "color": INK, "mew": 2},
    "not localized": {"marker": "o", "ms": 7, "mfc": "none", "mec": INK, "mew": 1.5},
}
_REFERENCE_LOOKS = {
    "dropped": {"marker": "^", "ms": 4, "mfc": "none", "mec": DROPPED, "mew": 0.8},
    "kept": {"marker": "^", "ms": 4.5, "color": CHOSEN, "mec": "none"},
}
_STEP_DEG = 30  # between lines of equal azimuth or elevation
_ROOM = 0.12  # around a map from above, over its radius


def sphere_chart(box: Box, references: Sequence[ReferencePlace], queries: Sequence[QueryPlace]) -> Figure:
    """Show from where the object is seen by references and queries, and which queries fail from there.

    The sphere is turned so that up is where the images' upper edges point on average and azimuth 0 is in
    the middle of the references; areas are true.

    Args:
        box: The object's box; directions are those from its middle.
        references: The images of the full map.
        queries: Queries that were localized against both maps.

    Raises:
        ValueError: There is no reference.
    """
    if not references:
        raise ValueError("references must hold at least one reference image")
    poses = [one.cam_from_world for one in references]
    seen = directions(poses, box, poses)
    asked = directions([one.cam_from_world for one in queries], box, poses)
    projection = fitting_projection(np.concatenate([seen, asked]))
    kept = np.array([one.kept for one in references])
    width, height = (9.6, 3.4) if projection.middle is None else (9.0, 5.4)
    with styled():
        figure = new_figure(width, height, "Directions from which queries fail, before and after")
        full, reduced = figure.subplots(1, 2)
        for axes, name, used, found in (
            (full, "Full map", np.ones_like(kept), [one.before for one in queries]),
            (reduced, "Reduced map", kept, [one.after for one in queries]),
        ):
            _draw_graticule(axes, projection)
            _draw_references(axes, projection.apply(seen), used)
            _draw_queries(axes, projection.apply(asked), found)
            axes.set_title(
                f"{name}: {plural(int(used.sum()), 'image')}\n{_counts(found)}", fontweight="normal"
            )
        figure.legend(handles=_legend(), loc="outside lower center", ncols=5)
    return figure


def _counts(found: Sequence[str]) -> str:
    return "queries: " + ", ".join(f"{found.count(verdict)} {verdict}" for verdict in _LOOKS)


def _draw_references(axes: Axes, places: Points2D, used: Mask) -> None:
    for name, some in (("dropped", ~used), ("kept", used)):
        axes.plot(*places[some].T, ls="none", label=name, zorder=2, **_REFERENCE_LOOKS[name])


def _draw_queries(axes: Axes, places: Points2D, found: Sequence[str]) -> None:
    for verdict, look in _LOOKS.items():
        some = np.array([one == verdict for one in found], bool)
        axes.plot(*places[some].T, ls="none", label=verdict, zorder=3, **look)


def _legend() -> list[Line2D]:
    words = {"kept": "image of the map", "dropped": "image dropped"}
    shown = [(words[name], look) for name, look in sorted(_REFERENCE_LOOKS.items(), reverse=True)]
    shown += [(f"query {verdict}", look) for verdict, look in _LOOKS.items()]
    return [Line2D([], [], ls="none", label=words, **look) for words, look in shown]


def _draw_graticule(axes: Axes, projection: Projection) -> None:
    axes.set_axis_off()
    axes.set_aspect("equal")
    for azimuth in range(-180, 181, _STEP_DEG):
        _draw_line(axes, projection, np.full(181, azimuth), np.linspace(-90, 90, 181))
    for elevation in range(-60, 61, _STEP_DEG):
        _draw_line(axes, projection, np.linspace(-180, 180, 361), np.full(361, elevation))
    if projection.middle is None:
        reach_x, reach_y = 2 * np.sqrt(2), np.sqrt(2)
    else:
        reach_x = reach_y = projection.radius
    angle = np.linspace(0, 2 * np.pi, 361)
    axes.plot(reach_x * np.cos(angle), reach_y * np.sin(angle), color=INK, alpha=0.5, lw=1)
    room = _ROOM if projection.is_from_above else 0.02
    axes.set_xlim(-(1 + room) * reach_x, (1 + room) * reach_x)
    axes.set_ylim(-(1 + room) * reach_y, (1 + room) * reach_y)
    _write_degrees(axes, projection)


def _draw_line(axes: Axes, projection: Projection, azimuth: np.ndarray, elevation: np.ndarray) -> None:
    """A line of equal azimuth or elevation, as far as the map shows it; equator and front are darker."""
    line = from_angles(azimuth, elevation)
    places = np.where(projection.shows(line)[:, None], projection.apply(line), np.nan)
    if projection.middle is None and azimuth[0] == -180 and azimuth[-1] == 180:
        places[[0, -1], 0] = np.array([-1, 1]) * abs(places[0, 0])  # the seam: both ends are one direction
    strong = (elevation == 0).all() or (azimuth == 0).all()
    axes.plot(*places.T, color=INK, alpha=0.3 if strong else 0.12, lw=0.8, zorder=1)


def _write_degrees(axes: Axes, projection: Projection) -> None:
    """Elevations along the line of azimuth 0; azimuths around a map from above, else along the equator."""
    for elevation in range(-60, 90, _STEP_DEG):
        place = from_angles(np.array([0.0]), np.array([elevation]))
        if projection.shows(place)[0] and elevation != 90 - projection.reach_deg:
            _write(axes, projection.apply(place)[0], f"{elevation}°")
    for azimuth in (-90, 0, 90, 180):
        if projection.is_from_above:
            angle = np.radians(azimuth - 90)
            outside = (1 + _ROOM / 2) * projection.radius
            _write(axes, outside * np.array([np.cos(angle), np.sin(angle)]), f"{azimuth}°")
        elif azimuth in (-90, 90):
            place = from_angles(np.array([azimuth]), np.array([0.0]))
            if projection.shows(place)[0]:
                _write(axes, projection.apply(place)[0], f"{azimuth}°")


def _write(axes: Axes, place: np.ndarray, text: str) -> None:
    axes.text(place[0], place[1], text, fontsize=7, alpha=0.7, ha="center", va="center", zorder=1.5)
