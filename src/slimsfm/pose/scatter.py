"""Refine a pose under a loss whose scale is the scatter of its own matches."""

import numpy as np
import poselib
import pycolmap
from jaxtyping import Float64

from slimsfm.pose.ransac import PinholeMatches, from_poselib, to_poselib

CAUCHY = 2.385
"""Scale of a Cauchy loss in sigmas: 95 % efficiency if the errors were normal."""

EXACT_PX = 1e-3
"""Smallest scatter: a loss needs a scale where matches are exact."""

MINIMAL = 4
"""Matches that a refinement needs."""

_ROUNDS = 6  # 2 to 4 are common
_SETTLED = 0.95  # of the scatter of the round before


def median_sigma(errors: Float64[np.ndarray, " n"]) -> float:
    """Standard deviation of each coordinate of normal errors in the plane, from their median length."""
    return float(np.median(errors) / np.sqrt(2 * np.log(2)))


def refine_to_scatter(
    matches: PinholeMatches, cam_from_world: pycolmap.Rigid3d, max_error_px: float
) -> pycolmap.Rigid3d:
    """Minimize the errors of the matches near a pose, in rounds.

    The limit of an inlier may be thirty times as large as the errors of right matches. Then a wrong match
    within the limit pulls the pose aside, and a loss of fixed scale lets it. So the scale is the scatter that
    the last round left, until it shrinks no more.

    Args:
        matches: The matches.
        cam_from_world: Pose to start from.
        max_error_px: Matches with larger errors before a round are not used in it; at first, three sigmas.

    Returns:
        The pose; that of the start if fewer than 4 matches are near it.
    """
    errors = matches.errors(cam_from_world)
    sigma = max_error_px / 3
    for _ in range(_ROUNDS):
        near = errors <= max_error_px
        if near.sum() < MINIMAL:
            break
        before, sigma = sigma, float(np.clip(median_sigma(errors[near]), EXACT_PX, max_error_px / 3))
        if sigma > _SETTLED * before:
            break
        found, _ = poselib.refine_absolute_pose(
            matches.pixels[near],
            matches.in_world[near],
            to_poselib(cam_from_world),
            matches.pinhole,
            {"loss_type": "CAUCHY", "loss_scale": CAUCHY * sigma},
        )
        cam_from_world = from_poselib(found)
        errors = matches.errors(cam_from_world)
    return cam_from_world
