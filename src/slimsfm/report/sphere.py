"""The directions from which queries fail, before and after a map was reduced, on an equal-area map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from slimsfm.arrays import Mask, Points2D, Points3D
from slimsfm.evaluation.results import Outcomes
from slimsfm.geometry import ADD_FRACTIONS, Box
from slimsfm.report.figures import CHOSEN, DROPPED, INK, RIGHT_COLOR, new_figure, styled
from slimsfm.report.formatting import format_count
from slimsfm.report.scene3d import view_frame

Verdict = Literal["right", "wrong", "not localized"]
"""Outcome of a query; right: error below a tenth of the diagonal."""

_LOOKS: dict[Verdict, dict] = {
    "right": {"marker": "o", "ms": 4.5, "color": RIGHT_COLOR, "mec": "none"},
    "wrong": {"marker": "x", "ms": 7, "color": INK, "mew": 2},
    "not localized": {"marker": "o", "ms": 7, "mfc": "none", "mec": INK, "mew": 1.5},
}
_REFERENCE_LOOKS = {
    "kept": {"marker": "^", "ms": 4.5, "color": CHOSEN, "mec": "none"},
    "dropped": {"marker": "^", "ms": 4, "mfc": "none", "mec": DROPPED, "mew": 0.8},
}
_STEP_DEG = 30  # between lines of equal azimuth or elevation
_ROOM = 0.12  # around a map from above, relative to its radius
_MAX_REACH_DEG = 105.0  # of an azimuthal map; beyond it the whole sphere is shown
_STEEP_DEG = 30.0  # distance from the zenith within which the map is centered at the zenith
_REACH_STEP_DEG = 15
_ITERATIONS = 30  # of Newton's method


def query_verdicts(outcomes: Outcomes) -> list[Verdict]:
    """Verdict on each query."""
    poses = zip(outcomes.error, outcomes.cam_from_world, strict=True)
    return [
        "not localized" if pose is None else "right" if error < ADD_FRACTIONS[0] else "wrong"
        for error, pose in poses
    ]


def sphere_chart(
    box: Box,
    references: Mapping[str, pycolmap.Rigid3d],
    kept: Sequence[str],
    queries: Sequence[pycolmap.Rigid3d],
    verdicts: tuple[Sequence[Verdict], Sequence[Verdict]],
) -> Figure:
    """Draw from where references and queries see the object, and which queries fail, on equal-area maps.

    Elevation 90° is the mean upward direction of the images, azimuth 0° the mean direction of the references.

    Args:
        box: The object's box; directions are relative to its center.
        references: Poses of the images of the full map, camera from world, by name.
        kept: Names of the images that the reduced map has.
        queries: True poses of the queries, camera from world.
        verdicts: Verdicts on the queries with the full and the reduced map.

    Raises:
        ValueError: `references` is empty, or `verdicts` do not have the length of `queries`.
    """
    if not references:
        raise ValueError("references must hold at least one reference image")
    if any(len(some) != len(queries) for some in verdicts):
        raise ValueError(f"verdicts must hold one verdict per query, got {[*map(len, verdicts)]}")
    poses = list(references.values())
    seen, asked = view_directions(poses, box, poses), view_directions(queries, box, poses)
    projection = fitting_projection(np.concatenate([seen, asked]))
    in_reduced = np.array([name in set(kept) for name in references])
    width, height = (9.6, 3.4) if projection.middle is None else (9.0, 5.4)
    with styled():
        figure = new_figure(width, height, "Directions from which queries fail, before and after")
        panels = zip(figure.subplots(1, 2), ("Full map", "Reduced map"), verdicts, strict=True)
        for (axes, name, found), used in zip(panels, (np.ones_like(in_reduced), in_reduced), strict=True):
            _draw_graticule(axes, projection)
            _draw_references(axes, projection.apply(seen), used)
            _draw_queries(axes, projection.apply(asked), found)
            counts = ", ".join(f"{list(found).count(verdict)} {verdict}" for verdict in _LOOKS)
            title = f"{name}: {format_count(int(used.sum()), 'image')}\nqueries: {counts}"
            axes.set_title(title, fontweight="normal")
        figure.legend(handles=_legend(), loc="outside lower center", ncols=5)
    return figure


def view_directions(
    cams_from_world: Sequence[pycolmap.Rigid3d], box: Box, references: Sequence[pycolmap.Rigid3d]
) -> Points3D:
    """Unit vectors from the center of a box to cameras, in the view's frame of the references."""
    centers = np.array([pose.inverse().translation for pose in cams_from_world], np.float64).reshape(-1, 3)
    vectors = view_frame(list(references), box).apply(centers)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def angles_deg(directions: Points3D) -> Float64[np.ndarray, "n 2"]:
    """Azimuth in (-180, 180], from x toward y, and elevation in [-90, 90]."""
    x, y, z = directions.T
    return np.degrees(np.stack([np.arctan2(y, x), np.arcsin(np.clip(z, -1, 1))], axis=1))


def from_angles(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> Points3D:
    """Unit vectors of azimuths and elevations, the inverse of `angles_deg`."""
    azimuth, elevation = np.broadcast_arrays(np.radians(azimuth_deg), np.radians(elevation_deg))
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereProjection:
    """An equal-area map of the sphere, or of a cap of it."""

    middle: Float64[np.ndarray, "3"] | None
    """Center of Lambert's azimuthal map; None for Mollweide's map of the whole sphere."""

    reach_deg: float
    """Largest angle from the center that the map shows."""

    @property
    def is_from_above(self) -> bool:
        """Whether the center is the zenith."""
        return self.middle is not None and bool(self.middle[2] == 1)

    @property
    def radius(self) -> float:
        """Radius of Lambert's map, for a unit sphere."""
        return 2 * np.sin(np.radians(self.reach_deg) / 2)

    def apply(self, directions: Points3D) -> Points2D:
        """Positions of unit vectors on the map.

        The sphere is seen from outside: azimuth increases to the right; from above, azimuth 0 is at the
        bottom.
        """
        return mollweide(directions) if self.middle is None else lambert(directions, self.middle)

    def shows(self, directions: Points3D) -> np.ndarray:
        """Which unit vectors are within reach."""
        if self.middle is None:
            return np.ones(len(directions), bool)
        return directions @ self.middle >= np.cos(np.radians(self.reach_deg)) - 1e-9


def fitting_projection(directions: Points3D) -> SphereProjection:
    """Choose a map around the mean direction or the zenith, or of the whole sphere."""
    middle = directions.mean(axis=0)
    length = float(np.linalg.norm(middle))
    zenith = np.array([0.0, 0.0, 1.0])
    steep = length < 1e-6 or middle[2] / length >= np.cos(np.radians(_STEEP_DEG))
    center = zenith if steep else middle / length
    farthest = float(np.degrees(np.arccos(np.clip(directions @ center, -1, 1)).max()))
    if farthest > _MAX_REACH_DEG:
        return SphereProjection(middle=None, reach_deg=180.0)
    reach = _REACH_STEP_DEG * max(2, int(np.ceil((farthest + 2) / _REACH_STEP_DEG)))
    return SphereProjection(middle=center, reach_deg=float(reach))


def lambert(directions: Points3D, middle: Float64[np.ndarray, "3"]) -> Points2D:
    """Lambert's azimuthal equal-area map of unit vectors around a center."""
    right = np.array([-middle[1], middle[0], 0.0])
    length = np.linalg.norm(right)
    right = right / length if length > 1e-9 else np.array([0.0, 1.0, 0.0])
    up = np.cross(middle, right)
    scale = np.sqrt(2 / np.maximum(1 + directions @ middle, 1e-12))
    return np.stack([scale * (directions @ right), scale * (directions @ up)], axis=1)


def mollweide(directions: Points3D) -> Points2D:
    """Mollweide's equal-area map of unit vectors, an ellipse with azimuth 0 in the middle."""
    azimuth, elevation = np.radians(angles_deg(directions)).T
    angle = elevation.copy()
    for _ in range(_ITERATIONS):
        slope = np.maximum(2 + 2 * np.cos(2 * angle), 1e-9)
        angle -= (2 * angle + np.sin(2 * angle) - np.pi * np.sin(elevation)) / slope
        angle = np.clip(angle, -np.pi / 2, np.pi / 2)
    return np.stack([2 * np.sqrt(2) / np.pi * azimuth * np.cos(angle), np.sqrt(2) * np.sin(angle)], axis=1)


def _draw_references(axes: Axes, places: Points2D, used: Mask) -> None:
    for name, some in (("dropped", ~used), ("kept", used)):
        axes.plot(*places[some].T, ls="none", label=name, zorder=2, **_REFERENCE_LOOKS[name])


def _draw_queries(axes: Axes, places: Points2D, found: Sequence[str]) -> None:
    for verdict, look in _LOOKS.items():
        some = np.array([one == verdict for one in found], bool)
        axes.plot(*places[some].T, ls="none", label=verdict, zorder=3, **look)


def _legend() -> list[Line2D]:
    labels = {"kept": "image of the map", "dropped": "image dropped"}
    looks = {labels[name]: look for name, look in _REFERENCE_LOOKS.items()}
    looks |= {f"query {verdict}": look for verdict, look in _LOOKS.items()}
    return [Line2D([], [], ls="none", label=label, **look) for label, look in looks.items()]


def _draw_graticule(axes: Axes, projection: SphereProjection) -> None:
    axes.set_axis_off()
    axes.set_aspect("equal")
    for azimuth in range(-180, 181, _STEP_DEG):
        _draw_line(axes, projection, np.full(181, azimuth), np.linspace(-90, 90, 181))
    for elevation in range(-60, 61, _STEP_DEG):
        _draw_line(axes, projection, np.linspace(-180, 180, 361), np.full(361, elevation))
    half_width, half_height = np.full(2, projection.radius)
    if projection.middle is None:
        half_width, half_height = 2 * np.sqrt(2), np.sqrt(2)
    angle = np.linspace(0, 2 * np.pi, 361)
    axes.plot(half_width * np.cos(angle), half_height * np.sin(angle), color=INK, alpha=0.5, lw=1)
    room = 1 + (_ROOM if projection.is_from_above else 0.02)
    axes.set_xlim(-room * half_width, room * half_width)
    axes.set_ylim(-room * half_height, room * half_height)
    _write_degrees(axes, projection)


def _draw_line(axes: Axes, projection: SphereProjection, azimuth: np.ndarray, elevation: np.ndarray) -> None:
    """Draw the visible part of a line of equal azimuth or elevation; equator and front are darker."""
    line = from_angles(azimuth, elevation)
    places = np.where(projection.shows(line)[:, None], projection.apply(line), np.nan)
    if projection.middle is None and azimuth[0] == -180 and azimuth[-1] == 180:
        places[[0, -1], 0] = np.array([-1, 1]) * abs(places[0, 0])  # the seam: both ends are one direction
    strong = (elevation == 0).all() or (azimuth == 0).all()
    axes.plot(*places.T, color=INK, alpha=0.3 if strong else 0.12, lw=0.8, zorder=1)


def _write_degrees(axes: Axes, projection: SphereProjection) -> None:
    """Write elevations along azimuth 0, and azimuths around a map from above, else along the equator."""
    for elevation in range(-60, 90, _STEP_DEG):
        place = from_angles(np.array([0.0]), np.array([elevation]))
        if projection.shows(place)[0] and elevation != 90 - projection.reach_deg:
            _write(axes, projection.apply(place)[0], f"{elevation}°")
    for azimuth in (-90, 0, 90, 180):
        place = from_angles(np.array([azimuth]), np.array([0.0]))
        if projection.is_from_above:
            angle = np.radians(azimuth - 90)
            outside = (1 + _ROOM / 2) * projection.radius
            _write(axes, outside * np.array([np.cos(angle), np.sin(angle)]), f"{azimuth}°")
        elif azimuth in (-90, 90) and projection.shows(place)[0]:
            _write(axes, projection.apply(place)[0], f"{azimuth}°")


def _write(axes: Axes, place: np.ndarray, text: str) -> None:
    axes.text(place[0], place[1], text, fontsize=7, alpha=0.7, ha="center", va="center", zorder=1.5)
