"""The gray frames that the tracker works on, and the optical flow between two of them."""

from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap

from slimsfm.arrays import GrayImage, Image, Mask, Points2D

_WINDOW_PX = 13
_LEVELS = 3  # halvings: points are found up to some 40 pixels from where they are expected
_STEPS = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03  # kind, most steps, last step in pixels


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
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_LEVELS,
        criteria=_STEPS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    points2D = places.astype(np.float64) + 0.5
    found = inside & (status[:, 0] == 1) & np.all((points2D > 0) & (points2D < (width, height)), axis=1)
    return Flow(points2D=points2D, found=found)
