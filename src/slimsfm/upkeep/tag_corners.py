"""Corners of a printed square to a small fraction of a pixel: where its four edges meet.

`cv2.cornerSubPix` and contours put the corners of a blurred square inside it, by a quarter of a pixel and
more, which makes a tag half a percent too small. Edges have no such bias.
"""

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import GrayImage, Points2D

_HALF_PIXEL = 0.5  # from OpenCV's pixels to COLMAP's
_PROFILES = 24  # along an edge
_PART = (0.08, 0.92)  # of the edge, away from the corners
_REACH, _LEAST_REACH_PX = 0.06, 1.5  # to either side of the edge, over the height of the square on it
_STEP_PX = 0.25
_ROUNDS = 3
_LEAST_CONTRAST = 0.3  # of an edge over that of the best profile
_MOVES_PX = 3.0  # farther from the first guess is another corner

Corners = Float64[np.ndarray, "4 2"]


def refine_corners(photo: GrayImage, corners: Corners, camera: pycolmap.Camera) -> Corners | None:
    """Fit lines to the edges of a dark square on bright ground, and intersect them.

    Lines are straight in rays, so the distortion of the lens does not bend them.

    Args:
        photo: The photo.
        corners: Corners to a pixel or two, in order.
        camera: Its intrinsics.

    Returns:
        The corners, or None where edges cannot be seen, or are somewhere else.
    """
    values, found = photo.astype(np.float32), corners
    for _ in range(_ROUNDS):
        lines = [_line(values, found, side, camera) for side in range(4)]
        if any(line is None for line in lines):
            return None
        meets = np.array([_meet(lines[side - 1], lines[side]) for side in range(4)])  # type: ignore[arg-type]
        if not np.isfinite(meets).all():
            return None
        found = np.asarray(camera.img_from_cam(np.column_stack([meets, np.ones(4)])), np.float64)
    moved = np.linalg.norm(found - corners, axis=1).max()
    return found if moved < _MOVES_PX else None


def _line(
    photo: np.ndarray, corners: Corners, side: int, camera: pycolmap.Camera
) -> Float64[np.ndarray, "3"] | None:
    """The line of an edge in rays, as coefficients of x, y and 1."""
    start, end = corners[side], corners[(side + 1) % 4]
    along = (end - start) / max(np.linalg.norm(end - start), 1e-9)
    outward = np.array([along[1], -along[0]])  # corners are clockwise in an image whose y axis points down
    height = np.mean([(start - corners[k]) @ outward for k in ((side + 2) % 4, (side + 3) % 4)])
    reach = max(_LEAST_REACH_PX, _REACH * float(height))
    places = start + np.linspace(*_PART, _PROFILES)[:, None] * (end - start)
    offsets = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    edge = _edges(photo, places, outward, offsets)
    if len(edge) < _PROFILES // 2:
        return None
    return _fit(np.asarray(camera.cam_from_img(edge), np.float64))


def _edges(
    photo: np.ndarray, places: Points2D, outward: Float64[np.ndarray, "2"], offsets: Float64[np.ndarray, " k"]
) -> Points2D:
    """Where profiles across an edge get bright: the mean of the offsets, weighted by the rise."""
    pixels = places[:, None] + offsets[:, None] * outward - _HALF_PIXEL
    x, y = np.moveaxis(pixels.astype(np.float32), 2, 0)
    profiles = cv2.remap(photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rises = np.maximum(np.diff(profiles, axis=1), 0)
    contrast = rises.sum(axis=1)
    clear = contrast > _LEAST_CONTRAST * max(contrast.max(), 1)
    middles = (offsets[1:] + offsets[:-1]) / 2
    at = rises[clear] @ middles / contrast[clear]
    return np.asarray(places[clear] + at[:, None] * outward, np.float64)


def _fit(rays: Points2D) -> Float64[np.ndarray, "3"]:
    """The line with the least squared distances, without points that are three deviations off."""
    kept, center, normal = np.ones(len(rays), bool), np.zeros(2), np.zeros(2)
    for _ in range(2):
        center = rays[kept].mean(axis=0)
        normal = np.linalg.svd(rays[kept] - center)[2][1]
        distances = np.abs((rays - center) @ normal)
        kept = distances <= 3 * 1.4826 * np.median(distances) + 1e-9
    return np.array([*normal, -normal @ center])


def _meet(one: Float64[np.ndarray, "3"], other: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "2"]:
    x, y, w = np.cross(one, other)
    return np.array([x, y]) / w if abs(w) > 1e-12 else np.full(2, np.inf)
