"""Points, cameras and box of a map, as the page's 3D view shows them at first, for paper."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from slimsfm.arrays import Points2D, Points3D
from slimsfm.geometry import BOX_EDGES
from slimsfm.mapping.map import Map
from slimsfm.report.figures import CHOSEN, DROPPED, new_figure, styled
from slimsfm.report.formatting import contents
from slimsfm.report.scene3d import Frame, view_frame

MAX_POINTS = 20_000
"""Points shown of a map: every so-manyth by id of more."""

_YAW, _PITCH = 0.5, 0.4  # of the eye about the box, radians
_MARGIN = 0.03  # around the cameras and the box, over the width of a panel
_PANEL_IN = 4.8  # width of a panel
_SHAPES = (0.55, 1.3)  # least and greatest height of a panel, over its width
_FRUSTUM_LENGTH = 0.12  # over the median distance of the cameras from the box
_FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))
_BOX = "#2268d8"
_POINT_PT2 = 2.2  # area of a point in the middle of the box
_NEAREST = 0.1  # depth of points that are drawn, over that of the box


@dataclass(frozen=True, kw_only=True, eq=False)
class _Eye:
    """A pinhole in the view's frame that looks at its origin."""

    axes: Float64[np.ndarray, "3 3"]
    """Rows: right, up and back."""

    distance: float
    """From the origin."""

    def depths(self, points: Points3D) -> np.ndarray:
        return self.distance - points @ self.axes[2]

    def see(self, points: Points3D) -> Points2D:
        """Where points lie in the picture."""
        depths = np.maximum(self.depths(points), 1e-3)
        return points @ self.axes[:2].T * (self.distance / depths)[:, None]


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """How all panels of a figure are seen."""

    frame: Frame
    """From the map's frame to the view's."""

    eye: _Eye
    """Where one looks from."""

    frustum_length: float
    """In the view's frame."""

    low: Float64[np.ndarray, "2"]
    """Corner of what is shown of the picture."""

    high: Float64[np.ndarray, "2"]
    """The opposite one."""

    @property
    def shape(self) -> float:
        """Height over width."""
        width, height = self.high - self.low
        return float(height / width)


def cloud_figure(map: Map, chosen: Collection[str] = ()) -> Figure:
    """Draw a map: its points, a frustum an image, the object's box.

    Args:
        map: The map.
        chosen: Names of images to be drawn in red.
    """
    return _figure([map], [chosen], ["Map"])


def before_after_figure(full: Map, reduced: Map) -> Figure:
    """Draw a map before and after it was reduced, side by side and seen from one place.

    Args:
        full: The map before; the images that the other has are red.
        reduced: The map after.
    """
    chosen = tuple(reduced.images)
    return _figure([full, reduced], [chosen, chosen], ["Before", "After"])


def _figure(maps: Sequence[Map], chosen: Sequence[Collection[str]], names: Sequence[str]) -> Figure:
    view = _view_of(maps[0])
    with styled():
        size = _PANEL_IN * len(maps), _PANEL_IN * view.shape + 0.3
        figure = new_figure(*size, f"Point cloud and cameras: {', '.join(names).lower()}")
        panels = figure.subplots(1, len(maps), squeeze=False)[0]
        for axes, one, red, name in zip(panels, maps, chosen, names, strict=True):
            _draw_points(axes, one, view)
            corners = view.eye.see(view.frame.apply(one.box.corners))
            _draw_lines(axes, [corners[list(edge)] for edge in BOX_EDGES], _BOX, 1.1, "box")
            _draw_frusta(
                axes, one, [key for key in one.images if key not in red], view, DROPPED, 0.5, "dropped"
            )
            _draw_frusta(axes, one, [key for key in one.images if key in red], view, CHOSEN, 1.4, "chosen")
            axes.set_title(f"{name}: {contents(one)}", fontweight="normal")
            _frame(axes, view)
    return figure


def _view_of(map: Map) -> _View:
    """The nearest view in its direction that shows the box and all cameras of a map."""
    poses = [image.cam_from_world() for image in map.images.values()]
    frame = view_frame(poses, map.box)
    centers = frame.apply(np.array([pose.inverse().translation for pose in poses]))
    distance = float(np.median(np.linalg.norm(centers, axis=1)))
    length = _FRUSTUM_LENGTH * distance
    frusta = [_frustum(map, name, frame, length) for name in map.images]
    shown = np.concatenate([frame.apply(map.box.corners), *frusta])
    back = _eye_axes()[2]
    eye = _Eye(axes=_eye_axes(), distance=max(2.2 * distance, float((shown @ back).max()) + distance))
    places = eye.see(shown)
    low, high = places.min(axis=0), places.max(axis=0)
    width, height = (1 + 2 * _MARGIN) * (high - low)
    width = max(width, height / _SHAPES[1])
    half = np.array([width, max(height, _SHAPES[0] * width)]) / 2
    middle = (low + high) / 2
    return _View(frame=frame, eye=eye, frustum_length=length, low=middle - half, high=middle + half)


def _eye_axes() -> Float64[np.ndarray, "3 3"]:
    cy, sy, cp, sp = np.cos(_YAW), np.sin(_YAW), np.cos(_PITCH), np.sin(_PITCH)
    return np.array([[-sy, cy, 0.0], [-cy * sp, -sy * sp, cp], [cy * cp, sy * cp, sp]])


def _frustum(map: Map, name: str, frame: Frame, length: float) -> Points3D:
    """The camera's centre and, at the given depth, the four corners of its image; distortion is left out."""
    camera = map.camera(name)
    width, height = camera.width, camera.height
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], np.float64)
    rays_in_cam = pixels @ np.linalg.inv(camera.calibration_matrix()).T
    depth_in_world = length / float(np.linalg.norm(frame.view_from_world[0]))
    corners_in_cam = np.concatenate([np.zeros((1, 3)), depth_in_world * rays_in_cam])
    return frame.apply(map.images[name].cam_from_world().inverse() * corners_in_cam)


def _draw_points(axes: Axes, map: Map, view: _View) -> None:
    """Points from far to near, those nearer larger, as pixels also where the rest is lines."""
    count = len(map.point3D_ids)
    rows = np.arange(count) if count <= MAX_POINTS else np.linspace(0, count - 1, MAX_POINTS).astype(np.int64)
    points = view.frame.apply(map.points3D_in_world[rows])
    shares = view.eye.depths(points) / view.eye.distance
    order = np.argsort(-shares, kind="stable")
    order = order[shares[order] > _NEAREST]
    areas = np.clip(_POINT_PT2 / shares[order] ** 2, 0.4, 9.0)
    colors = map.colors[rows][order] / 255
    places = view.eye.see(points[order])
    axes.scatter(*places.T, s=areas, c=colors, linewidths=0, rasterized=True, label="points")


def _draw_frusta(
    axes: Axes, map: Map, names: Sequence[str], view: _View, color: str, width: float, label: str
) -> None:
    frusta = [view.eye.see(_frustum(map, name, view.frame, view.frustum_length)) for name in names]
    _draw_lines(axes, [one[list(edge)] for one in frusta for edge in _FRUSTUM_EDGES], color, width, label)


def _draw_lines(axes: Axes, lines: Sequence[Points2D], color: str, width: float, label: str) -> None:
    axes.add_collection(LineCollection(lines, colors=color, linewidths=width, label=label, capstyle="round"))


def _frame(axes: Axes, view: _View) -> None:
    axes.set_xlim(view.low[0], view.high[0])
    axes.set_ylim(view.low[1], view.high[1])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set(visible=True, alpha=0.25)
