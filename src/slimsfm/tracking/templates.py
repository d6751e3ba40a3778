"""Small pictures of map points, and finding them again.

A template is cut out where its point was matched, and remembers what one step of its pixels is in the world.
From any later pose it can therefore be drawn as the camera should see it there, scaled, turned and
foreshortened as if the surface had faced the camera when it was cut out. So a point is always compared with
its first picture, which neither drifts nor takes on what comes to lie in front.
"""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64, Real, UInt8

from slimsfm.arrays import GrayImage, Ids, Mask, Points2D, Points3D
from slimsfm.geometry import project
from slimsfm.tracking.gray_frame import View

_SIDE_PX = 33  # of a template: holds a window turned and shrunk
_WINDOW_PX = 13  # of what is compared
_STEPS = 5  # of the alignment
_LONGEST_STEP_PX = 2.0
_TINY = np.float32(1e-9)
_MAX_SHIFT_PX = 5.0  # from where the pose puts the point
_MIN_LIKENESS = 0.75  # correlation of what was drawn with what is found
_MAX_TURN_DEG = 40.0  # between the directions a point is seen from; beyond, its first picture tells little
_MAX_SCALE = 1.8  # between its sizes then and now


@dataclass(frozen=True, kw_only=True, eq=False)
class Templates:
    """Points of a map and what they look like."""

    points3D_in_world: Points3D
    """The points."""

    pictures: UInt8[np.ndarray, "n side side"]
    """Grey; the point is at the centre."""

    steps_in_world: Float64[np.ndarray, "n 2 3"]
    """What one pixel to the right and one pixel down of a picture is in the world."""

    def __len__(self) -> int:
        return len(self.points3D_in_world)

    def __getitem__(self, rows: Ids) -> "Templates":
        return Templates(
            points3D_in_world=self.points3D_in_world[rows],
            pictures=self.pictures[rows],
            steps_in_world=self.steps_in_world[rows],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """Which templates were found in a picture, and where."""

    rows: Ids
    """Rows of the templates found, ascending."""

    points2D: Points2D
    """For each of them its place in pixels."""

    num_expected: int
    """Templates that should be in sight from where they were sought, but for what lies before them."""


def cut_out(
    view: View, points2D: Points2D, points3D_in_world: Points3D, cam_from_world: pycolmap.Rigid3d
) -> Templates:
    """Cut templates out of a frame around points matched in it, given its pose."""
    depths = (cam_from_world * points3D_in_world)[:, 2]
    right_and_down_in_world = cam_from_world.rotation.matrix()[:2]
    return Templates(
        points3D_in_world=points3D_in_world,
        pictures=_windows(view.gray, points2D, _SIDE_PX).astype(np.uint8),
        steps_in_world=depths[:, None, None] / view.camera.mean_focal_length() * right_and_down_in_world,
    )


def joined(new: Templates, old: Templates, limit: int) -> Templates:
    """New templates and, up to a limit, the old ones of other points."""
    known = {point.tobytes() for point in new.points3D_in_world}
    kept = [row for row, point in enumerate(old.points3D_in_world) if point.tobytes() not in known]
    rest = old[np.array(kept[: max(limit - len(new), 0)], np.int64)]
    return Templates(
        points3D_in_world=np.concatenate([new.points3D_in_world, rest.points3D_in_world]),
        pictures=np.concatenate([new.pictures, rest.pictures]),
        steps_in_world=np.concatenate([new.steps_in_world, rest.steps_in_world]),
    )


def spread(
    points2D: Points2D, points3D_in_world: Points3D, limit: int, cell_px: float
) -> Int64[np.ndarray, " chosen"]:
    """Choose matches that lie well apart: of each cell of a grid one, then of each a second, and so on.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: A point matched twice counts once.
        limit: Most matches to choose.
        cell_px: Side of a cell.

    Returns:
        Their rows, ascending.
    """
    _, rows = np.unique(points3D_in_world, axis=0, return_index=True)
    rows = np.sort(rows)
    _, cells = np.unique(np.floor(points2D[rows] / cell_px), axis=0, return_inverse=True)
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], cells[order])
    turn = np.empty(len(rows), np.int64)
    turn[order] = np.arange(len(rows)) - starts
    return np.sort(rows[np.argsort(turn, kind="stable")[:limit]])


def find(templates: Templates, view: View, cam_from_world: pycolmap.Rigid3d) -> Sighting:
    """Find templates near where a pose puts their points.

    Each is drawn as it should look from the pose and moved to where the picture is most like it [1], both
    made of mean 0 and length 1, so that the light does not matter. O(templates).

    Args:
        templates: What to find.
        view: The frame.
        cam_from_world: About where its camera stands, right to within a few pixels.

    References:
        [1] Baker and Matthews, Lucas-Kanade 20 Years On: A Unifying Framework, IJCV 2004.
    """
    points2D = project(templates.points3D_in_world, cam_from_world, view.camera)
    picture_from_image = _picture_from_image(templates, cam_from_world, view.camera)
    alike = _is_alike(templates, picture_from_image, cam_from_world)
    rows = np.flatnonzero(alike & _is_inside(points2D, view.gray))
    if not len(rows):
        return Sighting(rows=rows, points2D=np.zeros((0, 2)), num_expected=0)
    drawn = _drawn(templates.pictures[rows], picture_from_image[rows])
    places, likeness = _align(drawn, view.gray, points2D[rows])
    near = np.linalg.norm(places - points2D[rows], axis=1) <= _MAX_SHIFT_PX
    good = near & (likeness >= _MIN_LIKENESS)
    return Sighting(rows=rows[good], points2D=places[good], num_expected=len(rows))


def _picture_from_image(
    templates: Templates, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera
) -> Float64[np.ndarray, "n 2 2"]:
    """How steps in the image become steps in each template's picture; distortion does not matter so near."""
    in_cam = cam_from_world * templates.points3D_in_world
    steps = templates.steps_in_world @ cam_from_world.rotation.matrix().T
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = in_cam[:, None, :2] / in_cam[:, None, 2:]
        in_image = camera.mean_focal_length() / in_cam[:, None, 2:] * (steps[..., :2] - rays * steps[..., 2:])
        (a, b), (c, d) = np.moveaxis(in_image, 0, 2)  # rows: what a step right, a step down becomes
        return np.moveaxis(np.array([[d, -c], [-b, a]]) / (a * d - b * c), 2, 0)


def _is_alike(
    templates: Templates,
    picture_from_image: Float64[np.ndarray, "n 2 2"],
    cam_from_world: pycolmap.Rigid3d,
) -> Mask:
    """Which points a pose sees about as they were when they were cut out."""
    in_cam = cam_from_world * templates.points3D_in_world
    away = np.cross(templates.steps_in_world[:, 0], templates.steps_in_world[:, 1])
    away_in_cam = away @ cam_from_world.rotation.matrix().T
    lengths = np.linalg.norm(away, axis=1) * np.linalg.norm(in_cam, axis=1)
    facing = np.sum(in_cam * away_in_cam, axis=1) >= np.cos(np.radians(_MAX_TURN_DEG)) * lengths
    shrunk_by = np.sqrt(np.abs(np.linalg.det(np.nan_to_num(picture_from_image))))
    return (in_cam[:, 2] > 0) & facing & (shrunk_by <= _MAX_SCALE) & (shrunk_by >= 1 / _MAX_SCALE)


def _is_inside(points2D: Points2D, gray: GrayImage) -> Mask:
    margin = _WINDOW_PX / 2
    return np.all((points2D >= margin) & (points2D <= np.array(gray.shape[::-1]) - margin), axis=1)


def _drawn(
    pictures: UInt8[np.ndarray, "n side side"], picture_from_image: Float64[np.ndarray, "n 2 2"]
) -> Float32[np.ndarray, "n drawn drawn"]:
    """The pictures as the image should show them, one pixel wider on each side than what is compared."""
    side_px = _WINDOW_PX + 2
    offsets = picture_from_image.astype(np.float32) @ _offsets(side_px).reshape(2, -1)
    places = np.clip(offsets.reshape(-1, 2, side_px, side_px) + (_SIDE_PX - 1) / 2, 0, _SIDE_PX - 1)
    tops = _SIDE_PX * np.arange(len(pictures), dtype=np.float32)  # one picture below the other
    return _sampled(pictures.reshape(-1, _SIDE_PX), places[:, 0], places[:, 1] + tops[:, None, None])


def _align(
    drawn: Float32[np.ndarray, "n drawn drawn"], gray: GrayImage, points2D: Points2D
) -> tuple[Points2D, Float64[np.ndarray, " n"]]:
    """Where the image is most like what was drawn, by inverse compositional Gauss-Newton, and how alike."""
    count = len(drawn)
    window = drawn[:, 1:-1, 1:-1].reshape(count, -1)
    wanted, length = _normalized(window)
    right = (drawn[:, 1:-1, 2:] - drawn[:, 1:-1, :-2]).reshape(count, -1) / 2
    down = (drawn[:, 2:, 1:-1] - drawn[:, :-2, 1:-1]).reshape(count, -1) / 2
    slopes = np.stack([right, down], axis=1) / length[:, None, None]
    slopes -= slopes.mean(axis=2, keepdims=True)
    step_from_slope = np.linalg.inv(slopes @ np.moveaxis(slopes, 1, 2) + _TINY * np.eye(2))
    places, values = points2D, gray.astype(np.float32)
    for _ in range(_STEPS):
        seen, _ = _normalized(_windows(values, places, _WINDOW_PX).reshape(count, -1))
        steps = (step_from_slope @ (slopes @ (seen - wanted)[..., None]))[..., 0]
        places = places - np.clip(steps, -_LONGEST_STEP_PX, _LONGEST_STEP_PX)
    seen, _ = _normalized(_windows(values, places, _WINDOW_PX).reshape(count, -1))
    return places, np.einsum("np,np->n", seen, wanted).astype(np.float64)


def _normalized(
    windows: Float32[np.ndarray, "n p"],
) -> tuple[Float32[np.ndarray, "n p"], Float32[np.ndarray, " n"]]:
    """Windows of mean 0 and length 1, and their length before; a window of one grey becomes 0."""
    centred = windows - windows.mean(axis=1, keepdims=True)
    length = np.maximum(np.sqrt(np.einsum("np,np->n", centred, centred)), np.float32(1e-3))
    return centred / length[:, None], length


def _windows(
    gray: Real[np.ndarray, "h w"], points2D: Points2D, side_px: int
) -> Float32[np.ndarray, "n side side"]:
    """What surrounds points of an image."""
    x, y = (points2D.T - 0.5).astype(np.float32)[..., None, None]  # the top-left pixel's centre is OpenCV's 0
    right, down = _offsets(side_px)
    return _sampled(gray, x + right, y + down)


@cache
def _offsets(side_px: int) -> Float32[np.ndarray, "2 side side"]:
    """From the middle of a square to its pixels, right and down."""
    line = np.arange(side_px, dtype=np.float32) - np.float32((side_px - 1) / 2)
    return np.stack(np.meshgrid(line, line))


def _sampled(
    gray: Real[np.ndarray, "h w"],
    x: Float32[np.ndarray, "n side side"],
    y: Float32[np.ndarray, "n side side"],
) -> Float32[np.ndarray, "n side side"]:
    """Bilinear values; the centre of the top-left pixel is (0, 0)."""
    side = x.shape[-1]
    values = cv2.remap(
        gray, x.reshape(-1, side), y.reshape(-1, side), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return values.reshape(-1, side, side).astype(np.float32, copy=False)
