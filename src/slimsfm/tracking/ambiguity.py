"""Points on a small plane fit two poses: one leans towards the camera as much as the other leans away."""

import numpy as np
import pycolmap

from slimsfm.arrays import Points2D, Points3D
from slimsfm.geometry import Box, corner_error, reprojection_errors
from slimsfm.pose import refine_pose

_MAX_ERROR_PX = 6.0  # of a point that helps to find the second pose
_LEAST_ERROR_PX = 0.25  # to expect of a right pose
_FITS = 2.0  # times the error of the first pose, within which the second cannot be ruled out
_OTHER = 0.05  # corner error, over the diagonal, from which on two poses are two


def is_ambiguous(
    points2D: Points2D,
    points3D_in_world: Points3D,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    box: Box,
) -> bool:
    """Whether matches fit a second pose about as well as the one that was found.

    Far from the camera, depth hardly shows: mirrored in depth, points project to where they did. Of points on
    a plane the mirror image is a turned copy, so it is the picture of a pose [1]; of other points it is not.
    That pose is refined and fits, or it does not.

    Args:
        points2D: Pixels of matches that agree with the pose.
        points3D_in_world: What they were matched with.
        cam_from_world: The pose.
        camera: Intrinsics of the image.
        box: The object's box.

    References:
        [1] Schweighofer and Pinz, Robust Pose Estimation from a Planar Target, PAMI 2006.
    """
    mirrored = _mirrored(points3D_in_world, cam_from_world)
    second = refine_pose(
        points2D, points3D_in_world, mirrored, camera, max_error_px=_MAX_ERROR_PX
    ).cam_from_world
    if corner_error(cam_from_world, second, box) < _OTHER:
        return False
    first_px, second_px = (
        float(np.median(reprojection_errors(points2D, points3D_in_world, pose, camera)))
        for pose in (cam_from_world, second)
    )
    return second_px < _FITS * max(first_px, _LEAST_ERROR_PX)


def _mirrored(points3D_in_world: Points3D, cam_from_world: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
    """The pose that shows the plane nearest to the points mirrored in depth, about the middle of them."""
    center = points3D_in_world.mean(axis=0)
    normal = np.linalg.svd(points3D_in_world - center, full_matrices=False)[2][-1]
    center_in_cam = (cam_from_world * center[None])[0]
    ray = center_in_cam / np.linalg.norm(center_in_cam)
    rotation = _mirror(ray) @ cam_from_world.rotation.matrix() @ _mirror(normal)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), center_in_cam - rotation @ center)


def _mirror(normal: np.ndarray) -> np.ndarray:
    return np.eye(3) - 2 * np.outer(normal, normal)
