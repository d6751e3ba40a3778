"""Refine a pose by matches that are not equally exact."""

import numpy as np
import poselib
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points2D, Points3D
from slimsfm.geometry import reprojection_errors
from slimsfm.pose.ransac import PinholeMatches, from_poselib, to_poselib
from slimsfm.pose.scatter import CAUCHY, EXACT_PX, MINIMAL, median_sigma
from slimsfm.pose.types import PoseEstimate, pose_covariance

_CLASSES = 4  # per factor of two between spreads: within a class they differ by 9 % from its own


def refine_weighted(
    points2D: Points2D,
    points3D_in_world: Points3D,
    start_cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    spreads: Float64[np.ndarray, " n"],
    *,
    max_error_px: float,
) -> PoseEstimate:
    """Refine a pose by minimizing reprojection errors, each divided by the spread of its match.

    The scale of the Cauchy loss is the scatter of the matches at the start, so only the ratios of the spreads
    matter. PoseLib minimizes the errors. It knows no weights, but several cameras, and with focal length and
    pixels divided by k, errors are k times smaller. So matches of about equal spreads get their own camera.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map.
        start_cam_from_world: Pose to start from, with errors of right matches below `max_error_px`.
        camera: Intrinsics of the image.
        spreads: How much less exact each match is than the most exact ones; at least 1.
        max_error_px: Matches with larger errors at the start are not used; those with larger errors in the
            end are no inliers.

    Returns:
        The pose; that of the start, without covariance, if fewer than 4 matches are near it.
    """
    matches = PinholeMatches.of(points2D, points3D_in_world, camera)
    errors = reprojection_errors(points2D, points3D_in_world, start_cam_from_world, camera)
    near = errors[matches.rows] <= max_error_px
    found = start_cam_from_world
    if near.sum() >= MINIMAL:
        used = matches.rows[near]
        scatter = np.clip(median_sigma(errors[used] / spreads[used]), EXACT_PX, max_error_px / 3)
        found = _minimized(matches, near, scatter * spreads[matches.rows], start_cam_from_world)
    inliers = reprojection_errors(points2D, points3D_in_world, found, camera) <= max_error_px
    agree = inliers[matches.rows]
    covariance = None
    if agree.sum() >= MINIMAL and found is not start_cam_from_world:
        covariance = pose_covariance(
            matches.pixels[agree],
            matches.in_world[agree],
            found,
            matches.focal_px,
            spreads[matches.rows][agree],
        )
    return PoseEstimate(cam_from_world=found, inliers=inliers, covariance=covariance)


def _minimized(
    matches: PinholeMatches,
    used: np.ndarray,
    sigmas_px: Float64[np.ndarray, " n"],
    start_cam_from_world: pycolmap.Rigid3d,
) -> pycolmap.Rigid3d:
    classes = np.round(_CLASSES * np.log2(sigmas_px)).astype(np.int64)
    rows = [np.flatnonzero(used & (classes == one)) for one in np.unique(classes[used])]
    sigmas = [2.0 ** (classes[one[0]] / _CLASSES) for one in rows]
    found, _ = poselib.refine_generalized_absolute_pose(
        [matches.pixels[one] / sigma for one, sigma in zip(rows, sigmas, strict=True)],
        [matches.in_world[one] for one in rows],
        to_poselib(start_cam_from_world),
        [poselib.CameraPose()] * len(rows),
        [{**matches.pinhole, "params": [matches.focal_px / sigma, 0.0, 0.0]} for sigma in sigmas],
        {"loss_type": "CAUCHY", "loss_scale": CAUCHY},
    )
    return from_poselib(found)
