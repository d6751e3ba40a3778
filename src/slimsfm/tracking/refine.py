"""The pose nearest to a guess that matches agree on."""

import numpy as np
import poselib
import pycolmap

from slimsfm.arrays import Points2D, Points3D
from slimsfm.geometry import reprojection_errors
from slimsfm.pose import PoseEstimate, pose_covariance


def refine_pose(
    points2D: Points2D,
    points3D_in_world: Points3D,
    guess: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    max_error_px: float,
) -> PoseEstimate:
    """Minimize reprojection errors under Cauchy's loss, from a guessed pose on.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map.
        guess: `cam_from_world`, about right.
        camera: Intrinsics of the image; they are not refined.
        max_error_px: Largest reprojection error of an inlier.

    Returns:
        The pose, whatever it is worth: look at its inliers and its covariance.
    """
    focal = camera.mean_focal_length()
    pinhole_points2D = focal * np.asarray(camera.cam_from_img(points2D), np.float64).reshape(-1, 2)
    usable = np.isfinite(pinhole_points2D).all(axis=1)
    x, y, z, w = guess.rotation.quat
    start = poselib.CameraPose()
    start.q, start.t = np.array([w, x, y, z]), guess.translation
    pinhole = {"model": "SIMPLE_PINHOLE", "width": camera.width, "height": camera.height}
    found, _ = poselib.refine_absolute_pose(
        pinhole_points2D[usable],
        points3D_in_world[usable],
        start,
        {**pinhole, "params": [focal, 0.0, 0.0]},
        {"loss_type": "CAUCHY", "loss_scale": max_error_px / 3},
    )
    w, x, y, z = found.q
    cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), found.t)
    inliers = reprojection_errors(points2D, points3D_in_world, cam_from_world, camera) <= max_error_px
    covariance = pose_covariance(pinhole_points2D[inliers], points3D_in_world[inliers], cam_from_world, focal)
    return PoseEstimate(cam_from_world=cam_from_world, inliers=inliers, covariance=covariance)
