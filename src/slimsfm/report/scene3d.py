"""A map in 3D: one scene that the page, the figure and the live view show.

The view's frame has its origin at the center of the object's box, the box's diagonal as unit, z along the
mean upward direction of the images, and x toward the mean camera position.
"""

import base64
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float64, UInt8
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from slimsfm.arrays import Points2D, Points3D
from slimsfm.geometry import BOX_EDGES, Box
from slimsfm.mapping.map import Map
from slimsfm.report.figures import BOX_COLOR, CHOSEN, DROPPED, new_figure, styled
from slimsfm.report.formatting import format_map

MAX_POINTS = 15_000
"""Points shown per map."""

FRUSTUM_DEPTH = 0.12
"""Depth of a frustum, relative to the median distance of the cameras from the box."""

_FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewFrame:
    """A similarity transform from the map's frame to the view's."""

    origin_in_world: Float64[np.ndarray, "3"]
    """Center of the box."""

    view_from_world: Float64[np.ndarray, "3 3"]
    """Rotation, divided by the box's diagonal."""

    @property
    def rotation(self) -> Float64[np.ndarray, "3 3"]:
        """The rotation alone."""
        return self.view_from_world / np.linalg.norm(self.view_from_world[0])

    def apply(self, points3D_in_world: Points3D) -> Points3D:
        """Positions in the view's frame."""
        return (points3D_in_world - self.origin_in_world) @ self.view_from_world.T


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene3D:
    """Box and cameras of a map in the view's frame."""

    frame: ViewFrame
    """Transform from the map's frame."""

    box: Points3D
    """Corners of the object's box."""

    frusta: dict[str, Float64[np.ndarray, "5 3"]]
    """Per image the camera center and the four corners of the image plane, without distortion."""

    camera_distance: float
    """Median distance of the cameras from the origin."""


class ScenePoints(NamedTuple):
    """Points of a map in the view's frame."""

    positions: Points3D
    """Where they are."""

    colors: UInt8[np.ndarray, "n 3"]
    """RGB."""


def build_scene3d(map: Map) -> Scene3D:
    """Place box and cameras of a map in the view's frame."""
    poses = [image.cam_from_world() for image in map.images.values()]
    frame = view_frame(poses, map.box)
    centers = frame.apply(np.array([pose.inverse().translation for pose in poses]))
    distance = float(np.median(np.linalg.norm(centers, axis=1)))
    depth_in_world = FRUSTUM_DEPTH * distance * map.box.diagonal
    return Scene3D(
        frame=frame,
        box=frame.apply(map.box.corners),
        frusta={name: frame.apply(_frustum(map, name, depth_in_world)) for name in map.images},
        camera_distance=distance,
    )


def view_frame(cams_from_world: list[pycolmap.Rigid3d], box: Box) -> ViewFrame:
    """The view's frame for cameras with these poses."""
    ups = [-pose.rotation.matrix()[1] for pose in cams_from_world]
    to_cameras = [pose.inverse().translation - box.center for pose in cams_from_world]
    z = _unit(np.mean(ups, axis=0), np.array([0.0, 0.0, 1.0]))
    middle = np.mean(to_cameras, axis=0)
    x = _unit(middle - (middle @ z) * z, _any_normal(z))
    rotation = np.stack([x, np.cross(z, x), z])
    return ViewFrame(origin_in_world=box.center, view_from_world=rotation / box.diagonal)


def scene_points(map: Map, frame: ViewFrame, max_points: int | None = None) -> ScenePoints:
    """Points of a map, evenly subsampled by id if there are more than `max_points`."""
    count = len(map.point3D_ids)
    rows = np.arange(count)
    if max_points is not None and count > max_points:
        rows = np.linspace(0, count - 1, max_points).astype(np.int64)
    return ScenePoints(positions=frame.apply(map.points3D_in_world[rows]), colors=map.colors[rows])


def _unit(vector: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else fallback


def _any_normal(z: np.ndarray) -> np.ndarray:
    axis = np.eye(3)[np.argmin(np.abs(z))]
    normal = np.cross(z, axis)
    return normal / np.linalg.norm(normal)


def _frustum(map: Map, name: str, depth: float) -> Points3D:
    camera = map.camera(name)
    width, height = camera.width, camera.height
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], np.float64)
    rays_in_cam = pixels @ np.linalg.inv(camera.calibration_matrix()).T
    corners_in_cam = np.concatenate([np.zeros((1, 3)), depth * rays_in_cam])
    return map.images[name].cam_from_world().inverse() * corners_in_cam


def scene_json(maps: Mapping[str, Map], chosen: Collection[str], *, max_points: int = MAX_POINTS) -> dict:
    """The scene as plain values for `viewer.js`.

    Args:
        maps: Maps by name; the first is the full map, the others have some of its images.
        chosen: Images of the dominating set.
        max_points: Points shown per map.
    """
    full = next(iter(maps.values()))
    scene = build_scene3d(full)
    numbers = {name: number for number, name in enumerate(full.images)}
    return {
        "box": _rounded(scene.box),
        "edges": BOX_EDGES,
        "images": [_rounded(frustum) for frustum in scene.frusta.values()],
        "chosen": [int(name in chosen) for name in full.images],
        "maps": {
            name: {
                **_points_json(scene_points(shown, scene.frame, max_points)),
                "images": [numbers[image] for image in shown.images],
            }
            for name, shown in maps.items()
        },
    }


def _points_json(points: ScenePoints) -> dict[str, str]:
    return {"points": _base64(points.positions.astype("<f4")), "colors": _base64(points.colors)}


def _rounded(points: Points3D) -> list[list[float]]:
    return (np.round(points, 4) + 0.0).tolist()  # + 0.0 turns -0 into 0


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


_YAW, _PITCH = 0.5, 0.4  # radians, of the eye around the box, as in viewer.js
_MARGIN = 0.03  # around cameras and box, relative to the width of a panel
_PANEL_IN = 4.8  # width of a panel
_SHAPES = (0.55, 1.3)  # range of a panel's height over its width
_POINT_PT2 = 2.2  # area of a point at the center of the box
_NEAR = 0.1  # depth at which points are clipped, relative to that of the box


def before_after_figure(full: Map, reduced: Map) -> Figure:
    """Draw a map and a reduced map side by side, seen from the same place.

    Args:
        full: The full map; images that `reduced` keeps are red.
        reduced: A map reduced from it.
    """
    scene = build_scene3d(full)
    corners = np.concatenate([scene.box, *scene.frusta.values()])
    nearest = float((corners @ _eye_axes()[2]).max())
    distance = max(2.2 * scene.camera_distance, nearest + scene.camera_distance)
    low, high = _limits(_see(corners, distance)[0])
    shape = float((high - low)[1] / (high - low)[0])
    with styled():
        figure = new_figure(2 * _PANEL_IN, _PANEL_IN * shape + 0.3, "Points and cameras: before, after")
        panels = figure.subplots(1, 2)
        for axes, shown, name in zip(panels, (full, reduced), ("Before", "After"), strict=True):
            _draw_points(axes, scene_points(shown, scene.frame, MAX_POINTS), distance)
            _draw_lines(axes, [scene.box], BOX_EDGES, distance, BOX_COLOR, 1.1, "box")
            chosen = [scene.frusta[key] for key in shown.images if key in reduced.images]
            dropped = [scene.frusta[key] for key in shown.images if key not in reduced.images]
            _draw_lines(axes, dropped, _FRUSTUM_EDGES, distance, DROPPED, 0.5, "dropped")
            _draw_lines(axes, chosen, _FRUSTUM_EDGES, distance, CHOSEN, 1.4, "chosen")
            axes.set_title(f"{name}: {format_map(shown)}", fontweight="normal")
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
            for spine in axes.spines.values():
                spine.set(visible=True, alpha=0.25)
    return figure


def _eye_axes() -> Float64[np.ndarray, "3 3"]:
    """Rows: right, up and backward axis of the eye."""
    cy, sy, cp, sp = np.cos(_YAW), np.sin(_YAW), np.cos(_PITCH), np.sin(_PITCH)
    return np.array([[-sy, cy, 0.0], [-cy * sp, -sy * sp, cp], [cy * cp, sy * cp, sp]])


def _see(points: Points3D, distance: float) -> tuple[Points2D, np.ndarray]:
    """Where points appear in the picture, and their depths relative to the origin's."""
    seen = points @ _eye_axes().T
    shares = np.maximum(1 - seen[:, 2] / distance, 1e-3)
    return seen[:, :2] / shares[:, None], shares


def _limits(places: Points2D) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the part of the picture that is shown."""
    low, high = places.min(axis=0), places.max(axis=0)
    width, height = (1 + 2 * _MARGIN) * (high - low)
    width = max(width, height / _SHAPES[1])
    half = np.array([width, max(height, _SHAPES[0] * width)]) / 2
    return (low + high) / 2 - half, (low + high) / 2 + half


def _draw_points(axes: Axes, points: ScenePoints, distance: float) -> None:
    """Draw points from far to near, nearer ones larger, as pixels even in vector formats."""
    places, shares = _see(points.positions, distance)
    order = np.argsort(-shares, kind="stable")
    order = order[shares[order] > _NEAR]
    areas = np.clip(_POINT_PT2 / shares[order] ** 2, 0.4, 9.0)
    colors = points.colors[order] / 255
    axes.scatter(*places[order].T, s=areas, c=colors, linewidths=0, rasterized=True, label="points")


def _draw_lines(
    axes: Axes,
    shapes: Sequence[Points3D],
    edges: Collection[tuple[int, int]],
    distance: float,
    color: str,
    width: float,
    label: str,
) -> None:
    places = [_see(one, distance)[0] for one in shapes]
    lines = [one[list(edge)] for one in places for edge in edges]
    axes.add_collection(LineCollection(lines, colors=color, linewidths=width, label=label, capstyle="round"))
