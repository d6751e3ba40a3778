"""Localize an object that is not being tracked, and reject poses that a track must not begin with.

Searching a whole frame for an object that is not in it is the most expensive operation. So it happens as soon
as the object is lost and then after ever longer pauses. In the frames between, the object is searched for
where it was last seen: it is usually still there when whatever hid it is gone. The schedule counts frames, so
poses do not depend on the speed of the machine.
"""

from dataclasses import replace

import numpy as np
import pycolmap

from slimsfm.arrays import Image, Points2D, Points3D
from slimsfm.geometry import Box, corner_error, reprojection_errors
from slimsfm.localization import Localization, Localizer, Seconds
from slimsfm.pose import refine_pose
from slimsfm.tracking.track import MAX_CORNER_ERROR

_MAX_ERROR_PX = 6.0  # of a point that supports the second pose
_MIN_ERROR_PX = 0.25  # to expect of a right pose
_FITS = 2.0  # times the error of the first pose, within which the second one cannot be ruled out
_DIFFERENT = 0.05  # corner error, over the diagonal, at which two poses are different


class Relocalizer:
    """Localizes frames without a track."""

    def __init__(self, localizer: Localizer, longest_pause: int, min_confidence: float) -> None:
        """Set the schedule and the confidence that is required.

        Args:
            localizer: Localizer of the object's map.
            longest_pause: Largest number of frames from one search of a whole frame to the next.
            min_confidence: Smallest confidence of an accepted pose.
        """
        self._localizer = localizer
        self._longest_pause = longest_pause
        self._min_confidence = min_confidence
        self._last_cam_from_world: pycolmap.Rigid3d | None = None
        self._next, self._pause = 0, 1

    def mark_lost(self, frame_index: int, last_cam_from_world: pycolmap.Rigid3d) -> None:
        """Note that the track ends at this frame, so that the whole frame is searched."""
        self._last_cam_from_world = last_cam_from_world
        self._next, self._pause = frame_index, 1

    def localize(self, frame_index: int, image: Image, camera: pycolmap.Camera) -> Localization:
        """Localize a frame, searching all of it or only near the last pose, as the schedule says."""
        if frame_index >= self._next:
            self._next = frame_index + self._pause
            self._pause = min(2 * self._pause, self._longest_pause)
            return self._accepted(self._localizer.localize(image, camera))
        if self._last_cam_from_world is None:
            return _nothing(camera)
        return self._accepted(self._localizer.localize_near(image, camera, self._last_cam_from_world))

    def _accepted(self, found: Localization) -> Localization:
        confidence = found.pose and found.pose.confidence
        sure = confidence is None or confidence >= self._min_confidence
        if sure and (found.predicted_corner_error or 0.0) <= MAX_CORNER_ERROR:
            return found
        return replace(found, pose=None, predicted_corner_error=None)


def _nothing(camera: pycolmap.Camera) -> Localization:
    return Localization(
        pose=None,
        camera=camera,
        points2D=np.zeros((0, 2)),
        points3D_in_world=np.zeros((0, 3)),
        references=0,
        seconds=Seconds(extract=0.0, match=0.0, pose=0.0),
    )


def is_ambiguous(
    points2D: Points2D,
    points3D_in_world: Points3D,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    box: Box,
) -> bool:
    """Whether matches agree with a second pose about as well as with the estimated one.

    A small plane has two poses: in one it leans toward the camera as much as it leans away in the other. Far
    from the camera, depth is hardly visible: points mirrored in depth project to about the same pixels. The
    mirror image of points on a plane is a rotated copy of them, so a pose shows it [1]; for other points no
    pose does. That second pose is refined, and then its errors are compared with those of the first.

    Args:
        points2D: Pixels of matches that agree with the pose.
        points3D_in_world: The point matched with each pixel.
        cam_from_world: The estimated pose.
        camera: Intrinsics of the image.
        box: Box of the object.

    References:
        [1] Schweighofer and Pinz, Robust Pose Estimation from a Planar Target, PAMI 2006.
    """
    mirrored = _mirrored(points3D_in_world, cam_from_world)
    refined = refine_pose(points2D, points3D_in_world, mirrored, camera, max_error_px=_MAX_ERROR_PX)
    second = refined.cam_from_world
    if corner_error(cam_from_world, second, box) < _DIFFERENT:
        return False
    first_px, second_px = (
        float(np.median(reprojection_errors(points2D, points3D_in_world, pose, camera)))
        for pose in (cam_from_world, second)
    )
    return second_px < _FITS * max(first_px, _MIN_ERROR_PX)


def _mirrored(points3D_in_world: Points3D, cam_from_world: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
    """The pose that shows the best-fitting plane of the points mirrored in depth about their center."""
    center = points3D_in_world.mean(axis=0)
    normal = np.linalg.svd(points3D_in_world - center, full_matrices=False)[2][-1]
    center_in_cam = (cam_from_world * center[None])[0]
    ray = center_in_cam / np.linalg.norm(center_in_cam)
    rotation = _reflection(ray) @ cam_from_world.rotation.matrix() @ _reflection(normal)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), center_in_cam - rotation @ center)


def _reflection(normal: np.ndarray) -> np.ndarray:
    return np.eye(3) - 2 * np.outer(normal, normal)
