"""Optical flow: where the points of one picture are in the next."""

from dataclasses import dataclass

import cv2
import numpy as np

from slimsfm.arrays import GrayImage, Mask, Points2D

_WINDOW_PX = 13
_LEVELS = 3  # halvings: points are found up to some 40 pixels from where they are expected
_STEPS = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03  # kind, most steps, last step in pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class Flow:
    """Where points went."""

    points2D: Points2D
    """Pixels in the second picture; row i belongs to row i of the points asked for."""

    found: Mask
    """Which of them have a place inside the picture; whether it is the right one is not known yet."""


def follow_points(
    from_gray: GrayImage, to_gray: GrayImage, from_points2D: Points2D, guess_points2D: Points2D
) -> Flow:
    """Follow points from one picture to another of the same size, by pyramidal Lucas-Kanade [1].

    Args:
        from_gray: The first picture.
        to_gray: The second.
        from_points2D: Pixels in the first.
        guess_points2D: About where they are in the second.

    References:
        [1] Bouguet, Pyramidal Implementation of the Lucas Kanade Feature Tracker, Intel 2000.
    """
    if not len(from_points2D):
        return Flow(points2D=np.zeros((0, 2)), found=np.zeros(0, bool))
    height, width = to_gray.shape
    inside = np.all((guess_points2D > 0) & (guess_points2D < (width, height)), axis=1)
    guess = np.where(inside[:, None], guess_points2D, from_points2D)
    # OpenCV has the top-left pixel's centre at (0, 0)
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
