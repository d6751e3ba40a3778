"""Gray frames and optical flow; templates, small images of points, and the search for them in later frames.

A template is cut out around the pixel that its point was matched with, and stores what one step of its pixels
is in the world. So it can be drawn as the camera should see it from any later pose: scaled, rotated and
foreshortened, as if the surface had faced the camera when it was cut out. A point is always compared with its
first image, which neither drifts nor adapts to an object that passes in front.
"""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64, Real, UInt8

from slimsfm.arrays import GrayImage, Ids, Image, Mask, Points2D, Points3D
from slimsfm.geometry import project

_FLOW_WINDOW_PX = 13
_LEVELS = 3  # halvings: points are found up to some 40 pixels from where they are expected
_FLOW_STEPS = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03  # kind, steps, pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class GrayFrame:
    """A frame in gray, no larger than the tracker needs."""

    gray: GrayImage
    """Pixels."""

    camera: pycolmap.Camera
    """Intrinsics of the gray image."""

    scale: float
    """Width of the gray image over that of the frame."""


def to_gray_frame(image: Image, camera: pycolmap.Camera, max_size_px: int) -> GrayFrame:
    """Convert a frame to gray and shrink it so that its longer side has at most this many pixels."""
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    height, width = gray.shape
    if max(height, width) <= max_size_px:
        return GrayFrame(gray=gray, camera=camera, scale=1.0)
    factor = max_size_px / max(height, width)
    small_size = max(1, round(width * factor)), max(1, round(height * factor))
    small_camera = pycolmap.Camera(camera.todict())
    small_camera.rescale(*small_size)
    small = np.asarray(cv2.resize(gray, small_size, interpolation=cv2.INTER_AREA), np.uint8)
    return GrayFrame(gray=small, camera=small_camera, scale=small_size[0] / width)


@dataclass(frozen=True, kw_only=True, eq=False)
class Flow:
    """Points followed from one image to another."""

    points2D: Points2D
    """Pixels in the second image; row i belongs to row i of the given points."""

    found: Mask
    """Which points were found inside the image. They may still be wrong."""


def follow_points(
    from_gray: GrayImage, to_gray: GrayImage, from_points2D: Points2D, guess_points2D: Points2D
) -> Flow:
    """Follow points from one image to another of the same size, by pyramidal Lucas-Kanade [1].

    Args:
        from_gray: The first image.
        to_gray: The second image.
        from_points2D: Pixels in the first image.
        guess_points2D: Approximate pixels in the second image.

    References:
        [1] Bouguet, Pyramidal Implementation of the Lucas Kanade Feature Tracker, Intel 2000.
    """
    if not len(from_points2D):
        return Flow(points2D=np.zeros((0, 2)), found=np.zeros(0, bool))
    height, width = to_gray.shape
    inside = np.all((guess_points2D > 0) & (guess_points2D < (width, height)), axis=1)
    guess = np.where(inside[:, None], guess_points2D, from_points2D)
    # in OpenCV the center of the top-left pixel is (0, 0)
    places, status, _ = cv2.calcOpticalFlowPyrLK(
        from_gray,
        to_gray,
        (from_points2D - 0.5).astype(np.float32),
        (guess - 0.5).astype(np.float32),
        winSize=(_FLOW_WINDOW_PX, _FLOW_WINDOW_PX),
        maxLevel=_LEVELS,
        criteria=_FLOW_STEPS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    points2D = places.astype(np.float64) + 0.5
    found = inside & (status[:, 0] == 1) & np.all((points2D > 0) & (points2D < (width, height)), axis=1)
    return Flow(points2D=points2D, found=found)


_SIDE_PX = 33  # of a template: contains a rotated and shrunk window
_WINDOW_PX = 13  # of the part that is compared
_STEPS = 5  # of the alignment
_LONGEST_STEP_PX = 2.0
_TINY = np.float32(1e-9)
_MAX_SHIFT_PX = 5.0  # from where the pose puts the point
_MIN_SIMILARITY = 0.75  # correlation of the drawn template with the image
_MAX_TURN_DEG = 40.0  # between the directions a point is seen from; beyond, its template is of little use
_MAX_SCALE = 1.8  # ratio of its sizes then and now


@dataclass(frozen=True, kw_only=True, eq=False)
class Templates:
    """Points of a map and a small image of each."""

    points3D_in_world: Points3D
    """Positions of the points."""

    pictures: UInt8[np.ndarray, "n side side"]
    """Gray images; the point is at the center."""

    steps_in_world: Float64[np.ndarray, "n 2 3"]
    """Steps in the world, in map units, of one pixel to the right and one pixel down."""

    def __len__(self) -> int:
        return len(self.points3D_in_world)

    def __getitem__(self, rows: Ids) -> "Templates":
        return Templates(
            points3D_in_world=self.points3D_in_world[rows],
            pictures=self.pictures[rows],
            steps_in_world=self.steps_in_world[rows],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundTemplates:
    """Templates found in a frame."""

    rows: Ids
    """Rows of the found templates, ascending."""

    points2D: Points2D
    """Pixel of each found template."""

    num_expected: int
    """Number of templates in sight of the camera, not counting occlusion by other objects."""


def cut_templates(
    frame: GrayFrame, points2D: Points2D, points3D_in_world: Points3D, cam_from_world: pycolmap.Rigid3d
) -> Templates:
    """Cut out templates around matched pixels of a frame of known pose."""
    depths = (cam_from_world * points3D_in_world)[:, 2]
    right_and_down_in_world = cam_from_world.rotation.matrix()[:2]
    return Templates(
        points3D_in_world=points3D_in_world,
        pictures=_windows(frame.gray, points2D, _SIDE_PX).astype(np.uint8),
        steps_in_world=depths[:, None, None] / frame.camera.mean_focal_length() * right_and_down_in_world,
    )


def join_templates(new: Templates, old: Templates, limit: int) -> Templates:
    """The new templates and, up to a limit, the old templates of other points."""
    known = {point.tobytes() for point in new.points3D_in_world}
    kept = [row for row, point in enumerate(old.points3D_in_world) if point.tobytes() not in known]
    rest = old[np.array(kept[: max(limit - len(new), 0)], np.int64)]
    return Templates(
        points3D_in_world=np.concatenate([new.points3D_in_world, rest.points3D_in_world]),
        pictures=np.concatenate([new.pictures, rest.pictures]),
        steps_in_world=np.concatenate([new.steps_in_world, rest.steps_in_world]),
    )


def spread_over_cells(
    points2D: Points2D, points3D_in_world: Points3D, limit: int, cell_px: float
) -> Int64[np.ndarray, " chosen"]:
    """Choose matches spread over the image: one from each cell of a grid, then a second from each, and so on.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Matched points; a point matched twice counts once.
        limit: Largest number of matches to choose.
        cell_px: Side of a cell.

    Returns:
        Rows of the chosen matches, ascending.
    """
    _, rows = np.unique(points3D_in_world, axis=0, return_index=True)
    rows = np.sort(rows)
    _, cells = np.unique(np.floor(points2D[rows] / cell_px), axis=0, return_inverse=True)
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], cells[order])
    turn = np.empty(len(rows), np.int64)
    turn[order] = np.arange(len(rows)) - starts
    return np.sort(rows[np.argsort(turn, kind="stable")[:limit]])


def find_templates(
    templates: Templates, frame: GrayFrame, cam_from_world: pycolmap.Rigid3d
) -> FoundTemplates:
    """Find templates near the projections of their points.

    Each template is drawn as it should look from the pose and aligned with the frame [1]. Both are normalized
    to mean 0 and length 1, so brightness and contrast do not matter. Time is linear in the templates.

    Args:
        templates: Templates to find.
        frame: The frame to search.
        cam_from_world: Approximate pose of the frame, right to within a few pixels.

    References:
        [1] Baker and Matthews, Lucas-Kanade 20 Years On: A Unifying Framework, IJCV 2004.
    """
    points2D = project(templates.points3D_in_world, cam_from_world, frame.camera)
    template_from_image = _template_from_image(templates, cam_from_world, frame.camera)
    comparable = _is_comparable(templates, template_from_image, cam_from_world)
    rows = np.flatnonzero(comparable & _is_inside(points2D, frame.gray))
    if not len(rows):
        return FoundTemplates(rows=rows, points2D=np.zeros((0, 2)), num_expected=0)
    drawn = _drawn(templates.pictures[rows], template_from_image[rows])
    places, similarity = _align(drawn, frame.gray, points2D[rows])
    near = np.linalg.norm(places - points2D[rows], axis=1) <= _MAX_SHIFT_PX
    good = near & (similarity >= _MIN_SIMILARITY)
    return FoundTemplates(rows=rows[good], points2D=places[good], num_expected=len(rows))


def _template_from_image(
    templates: Templates, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera
) -> Float64[np.ndarray, "n 2 2"]:
    """Maps steps in the frame to steps in each template; distortion is negligible at this size."""
    in_cam = cam_from_world * templates.points3D_in_world
    steps = templates.steps_in_world @ cam_from_world.rotation.matrix().T
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = in_cam[:, None, :2] / in_cam[:, None, 2:]
        in_image = camera.mean_focal_length() / in_cam[:, None, 2:] * (steps[..., :2] - rays * steps[..., 2:])
        (a, b), (c, d) = np.moveaxis(in_image, 0, 2)  # rows: image of a step right, of a step down
        return np.moveaxis(np.array([[d, -c], [-b, a]]) / (a * d - b * c), 2, 0)


def _is_comparable(
    templates: Templates,
    template_from_image: Float64[np.ndarray, "n 2 2"],
    cam_from_world: pycolmap.Rigid3d,
) -> Mask:
    """Which points a pose sees from a similar direction and distance as when they were cut out."""
    in_cam = cam_from_world * templates.points3D_in_world
    away = np.cross(templates.steps_in_world[:, 0], templates.steps_in_world[:, 1])
    away_in_cam = away @ cam_from_world.rotation.matrix().T
    lengths = np.linalg.norm(away, axis=1) * np.linalg.norm(in_cam, axis=1)
    facing = np.sum(in_cam * away_in_cam, axis=1) >= np.cos(np.radians(_MAX_TURN_DEG)) * lengths
    shrunk_by = np.sqrt(np.abs(np.linalg.det(np.nan_to_num(template_from_image))))
    return (in_cam[:, 2] > 0) & facing & (shrunk_by <= _MAX_SCALE) & (shrunk_by >= 1 / _MAX_SCALE)


def _is_inside(points2D: Points2D, gray: GrayImage) -> Mask:
    margin = _WINDOW_PX / 2
    return np.all((points2D >= margin) & (points2D <= np.array(gray.shape[::-1]) - margin), axis=1)


def _drawn(
    pictures: UInt8[np.ndarray, "n side side"], template_from_image: Float64[np.ndarray, "n 2 2"]
) -> Float32[np.ndarray, "n drawn drawn"]:
    """The templates as the frame should show them, one pixel wider on each side than the compared window."""
    side_px = _WINDOW_PX + 2
    offsets = template_from_image.astype(np.float32) @ _offsets(side_px).reshape(2, -1)
    places = np.clip(offsets.reshape(-1, 2, side_px, side_px) + (_SIDE_PX - 1) / 2, 0, _SIDE_PX - 1)
    tops = _SIDE_PX * np.arange(len(pictures), dtype=np.float32)  # the templates are stacked vertically
    return _sampled(pictures.reshape(-1, _SIDE_PX), places[:, 0], places[:, 1] + tops[:, None, None])


def _align(
    drawn: Float32[np.ndarray, "n drawn drawn"], gray: GrayImage, points2D: Points2D
) -> tuple[Points2D, Float64[np.ndarray, " n"]]:
    """Align drawn templates with the frame by inverse compositional Gauss-Newton: pixels and correlations."""
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
    """Windows of mean 0 and length 1, and their lengths before; a uniform window becomes 0."""
    centered = windows - windows.mean(axis=1, keepdims=True)
    length = np.maximum(np.sqrt(np.einsum("np,np->n", centered, centered)), np.float32(1e-3))
    return centered / length[:, None], length


def _windows(
    gray: Real[np.ndarray, "h w"], points2D: Points2D, side_px: int
) -> Float32[np.ndarray, "n side side"]:
    """Square windows of an image around points."""
    x, y = (points2D.T - 0.5).astype(np.float32)[..., None, None]  # center of the top-left pixel: (0, 0)
    right, down = _offsets(side_px)
    return _sampled(gray, x + right, y + down)


@cache
def _offsets(side_px: int) -> Float32[np.ndarray, "2 side side"]:
    """Offsets from the center of a square to its pixels, right and down."""
    line = np.arange(side_px, dtype=np.float32) - np.float32((side_px - 1) / 2)
    return np.stack(np.meshgrid(line, line))


def _sampled(
    gray: Real[np.ndarray, "h w"],
    x: Float32[np.ndarray, "n side side"],
    y: Float32[np.ndarray, "n side side"],
) -> Float32[np.ndarray, "n side side"]:
    """Bilinear interpolation; the center of the top-left pixel is (0, 0)."""
    side = x.shape[-1]
    values = cv2.remap(
        gray, x.reshape(-1, side), y.reshape(-1, side), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return values.reshape(-1, side, side).astype(np.float32, copy=False)
