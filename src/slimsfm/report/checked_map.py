"""A picture of a checked map: the cameras from above, and where those that are wrong should stand."""

from collections.abc import Iterable, Mapping

import numpy as np
import pycolmap
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slimsfm.arrays import Points3D
from slimsfm.mapping.map import Map
from slimsfm.report.figures import CHOSEN, COLORS, DROPPED, INK, new_figure, styled
from slimsfm.upkeep.findings import MapCheck

_MOST_POINTS = 6000  # drawn
_LABELED = 20  # wrong images with a name
_REACH = 1.5  # of the quantile of the points' distances that is drawn
_LOOK = 0.06  # length of a viewing direction, over the width of the picture


def check_picture(map: Map, found: MapCheck) -> Figure:
    """Draw a map from above, along the mean direction that its images call down.

    Wrong cameras are red, with a line to where the others say that they stand. Cameras of parts that hang on
    the rest by a thread have a color of their own.
    """
    ground = _ground(map)
    count = len(found.wrong_names)
    label = f"{found.images} cameras from above, {count} of them wrong"
    with styled():
        figure = new_figure(7.0, 6.0, label)
        axes = figure.add_subplot()
        axes.set_aspect("equal")
        axes.set_axis_off()
        poses = {name: image.cam_from_world() for name, image in map.images.items()}
        stands = [one.others_cam_from_world for one in found.wrong]
        length = _LOOK * _width([*poses.values(), *stands], ground)
        _draw_points(axes, map, ground)
        right = {name: pose for name, pose in poses.items() if name not in found.wrong_names}
        _draw_cameras(axes, right.values(), ground, length, INK)
        for number, thread in enumerate(found.threads):
            part = [poses[name] for name in thread.part]
            _draw_cameras(axes, part, ground, length, COLORS[number % len(COLORS)])
        wrong = [poses[name] for name in found.wrong_names]
        _draw_cameras(axes, wrong, ground, length, CHOSEN)
        for one in found.wrong:
            _draw_cameras(axes, [one.others_cam_from_world], ground, length, CHOSEN, hollow=True)
            start, end = (_centers([p]) @ ground.T for p in (one.cam_from_world, one.others_cam_from_world))
            axes.plot(*np.concatenate([start, end]).T, color=CHOSEN, linewidth=0.9, linestyle="--")
        _label(axes, dict(zip(found.wrong_names, _centers(wrong) @ ground.T, strict=True)))
        axes.set_title(f"{label}; dashed: to where the others say" if found.wrong else label)
    return figure


def _label(axes: Axes, places: Mapping[str, np.ndarray]) -> None:
    """Names at some places, unless they are many."""
    for name, place in places.items() if len(places) <= _LABELED else ():
        axes.annotate(
            name, (place[0], place[1]), (4, 4), textcoords="offset points", color=CHOSEN, fontsize=7
        )


def _ground(map: Map) -> Float64[np.ndarray, "2 3"]:
    """Two unit vectors that span the plane which the images call horizontal; from above, x to the right."""
    turns = [image.cam_from_world().rotation.matrix() for image in map.images.values()]
    down = np.mean([turn[1] for turn in turns], axis=0)
    down /= max(float(np.linalg.norm(down)), 1e-12)
    across = turns[0][0] - (turns[0][0] @ down) * down
    if np.linalg.norm(across) < 1e-6:  # the first camera lies on its side
        across = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(across, down)])


def _centers(poses: Iterable[pycolmap.Rigid3d]) -> Points3D:
    return np.array([pose.inverse().translation for pose in poses]).reshape(-1, 3)


def _width(poses: list[pycolmap.Rigid3d], ground: Float64[np.ndarray, "2 3"]) -> float:
    return float(np.ptp(_centers(poses) @ ground.T, axis=0).max())


def _draw_points(axes: Axes, map: Map, ground: Float64[np.ndarray, "2 3"]) -> None:
    points = map.points3D_in_world[:: -(-len(map.point3D_ids) // _MOST_POINTS)]
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    near = points[distances <= _REACH * np.quantile(distances, 0.9)] @ ground.T
    axes.scatter(*near.T, s=0.6, color=DROPPED, alpha=0.5, linewidths=0, rasterized=True)


def _draw_cameras(
    axes: Axes,
    poses: Iterable[pycolmap.Rigid3d],
    ground: Float64[np.ndarray, "2 3"],
    length: float,
    color: str,
    *,
    hollow: bool = False,
) -> None:
    """Positions with lines in the viewing directions."""
    poses = list(poses)
    places = _centers(poses) @ ground.T
    ways = np.array([pose.rotation.matrix()[2] for pose in poses]).reshape(-1, 3) @ ground.T
    for place, way in zip(places, ways, strict=True):
        axes.plot(*np.stack([place, place + length * way]).T, color=color, linewidth=0.7)
    axes.scatter(
        *places.T, s=14, color="none" if hollow else color, edgecolors=color, linewidths=0.9, zorder=3
    )
