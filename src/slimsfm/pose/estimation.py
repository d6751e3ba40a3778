"""Estimate the pose of a camera from 2D-3D matches, with its focal length or the direction of gravity."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from slimsfm.arrays import Points2D, Points3D
from slimsfm.pose.priors import FocalPrior, Gravity, check_has_focal_length, with_focal_length
from slimsfm.pose.ransac import (
    P3P_SAMPLE,
    PinholeMatches,
    RansacOptions,
    check_matches,
    hypotheses_to_try,
    search_p3p,
    search_upright,
)
from slimsfm.pose.refinement import refine_pose
from slimsfm.pose.scatter import refine_to_scatter
from slimsfm.pose.types import PoseEstimate, pose_covariance

_MIN_INLIERS = 4  # of a hypothesis at a focal length that may be wrong
_MAX_SIGMAS = 4  # by which a pose may deviate from gravity; one in 3000 does


def estimate_pose(
    points2D: Points2D,
    points3D_in_world: Points3D,
    camera: pycolmap.Camera,
    options: RansacOptions = RansacOptions(),
    *,
    focal: FocalPrior | None = None,
    gravity: Gravity | None = None,
) -> PoseEstimate | None:
    """Estimate the pose of a camera from 2D-3D matches.

    P3P inside LO-RANSAC [1], then a refinement whose loss adapts to the scatter of the inliers. The lens
    distortion of any COLMAP camera model is removed first, so one solver serves all models.

    With an unknown focal length, P3P searches at several focal lengths [2], and pose and focal length are
    refined together from the hypothesis with the most inliers. At a focal length that is wrong by a fifth, a
    pose still has some of its inliers. Unlike a solver for both, P3P takes any lens distortion and planar
    points, and needs one match less. The prior keeps the focal length near the expected one where the matches
    do not determine it.

    With gravity and a known focal length, four unknowns remain, and two matches suffice [3]: where one match
    in ten is right, one hypothesis in a hundred is good, instead of one in a thousand. The refinement has all
    six unknowns and gravity as a prior. A pose that deviates from gravity by more than four standard
    deviations is rejected.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map.
        camera: Intrinsics of the image. Only its focal length is estimated, and only with `focal`.
        options: How to search; several focal lengths share the hypotheses.
        focal: Estimate the focal length too; two focal lengths keep their ratio.
        gravity: Direction of gravity.

    Returns:
        The pose, or None when no hypothesis has enough inliers or the matches contradict gravity.

    Raises:
        ValueError: The rows do not correspond, a coordinate is not finite, or the camera is spherical: it has
            no focal length, which the pinhole solver needs.

    References:
        [1] Chum, Matas and Kittler, Locally Optimized RANSAC, DAGM 2003.
        [2] Sattler, Sweeney and Pollefeys, On Sampling Focal Length Values to Solve the Absolute Pose
            Problem, ECCV 2014.
        [3] Kukelova, Bujnak and Pajdla, Closed-form Solutions to Minimal Absolute Pose Problems with Known
            Vertical Direction, ACCV 2010.
    """
    check_matches(points2D, points3D_in_world)
    check_has_focal_length(camera)
    if focal is not None:
        start = _over_focal_lengths(points2D, points3D_in_world, camera, options, focal)
    elif gravity is not None:
        start = _upright(points2D, points3D_in_world, camera, options, gravity)
    else:
        return _by_p3p(points2D, points3D_in_world, camera, options, is_final=True)
    if start is None:
        return None
    found = refine_pose(
        points2D,
        points3D_in_world,
        start.cam_from_world,
        start.camera,
        max_error_px=options.max_error_px,
        focal=focal,
        gravity=gravity,
    )
    if found.num_inliers < options.min_inliers or (gravity and _contradicts(found, start.camera, gravity)):
        return None
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class _Hypothesis:
    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera


def _by_p3p(
    points2D: Points2D,
    points3D_in_world: Points3D,
    camera: pycolmap.Camera,
    options: RansacOptions,
    *,
    is_final: bool = False,
) -> PoseEstimate | None:
    matches = PinholeMatches.of(points2D, points3D_in_world, camera)
    if len(matches.rows) < options.min_inliers:
        return None
    cam_from_world, found = search_p3p(matches, options)
    if is_final:
        cam_from_world = refine_to_scatter(matches, cam_from_world, options.max_error_px)
        found = np.flatnonzero(matches.errors(cam_from_world) <= options.max_error_px)
    if len(found) < options.min_inliers:
        return None
    inliers = np.zeros(len(points2D), dtype=bool)
    inliers[matches.rows[found]] = True
    covariance = pose_covariance(
        matches.pixels[found], matches.in_world[found], cam_from_world, matches.focal_px
    )
    return PoseEstimate(cam_from_world=cam_from_world, inliers=inliers, covariance=covariance)


def _upright(
    points2D: Points2D,
    points3D_in_world: Points3D,
    camera: pycolmap.Camera,
    options: RansacOptions,
    gravity: Gravity,
) -> _Hypothesis | None:
    matches = PinholeMatches.of(points2D, points3D_in_world, camera)
    if len(matches.rows) < options.min_inliers:
        return None
    pose = search_upright(matches, gravity, options)
    return pose and _Hypothesis(cam_from_world=pose, camera=camera)


def _over_focal_lengths(
    points2D: Points2D,
    points3D_in_world: Points3D,
    camera: pycolmap.Camera,
    options: RansacOptions,
    prior: FocalPrior,
) -> _Hypothesis | None:
    """The pose with the most inliers over all focal lengths; of equal ones, that of the likely focal length.

    The search ends early when more than half of the matches agree: any better pose would share inliers.
    """
    best, most = None, 0
    share = -(-options.max_iterations // len(prior.tried_px))
    for focal_px in prior.tried_px:
        tried = with_focal_length(camera, float(focal_px))
        enough = hypotheses_to_try(most / max(len(points2D), 1), P3P_SAMPLE)
        eased = replace(options, max_iterations=min(share, enough), min_inliers=_MIN_INLIERS)
        pose = _by_p3p(points2D, points3D_in_world, tried, eased)
        if pose and pose.num_inliers > most:
            best = _Hypothesis(cam_from_world=pose.cam_from_world, camera=tried)
            most = pose.num_inliers
        if most > len(points2D) / 2:
            break
    return best


def _contradicts(found: PoseEstimate, camera: pycolmap.Camera, gravity: Gravity) -> bool:
    return bool(np.linalg.norm(gravity.rows(found.cam_from_world, camera).residuals) > _MAX_SIGMAS)
