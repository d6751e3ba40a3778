"""What runs besides tracking: localization in the background, and finding a lost object again.

A frame is handed to another thread, and its result is used a fixed number of frames later: later than
necessary on a fast machine, after waiting on a slow one. So the poses depend on the frames alone.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Image, Points2D, Points3D
from slimsfm.geometry import Box, corner_error, reprojection_errors
from slimsfm.localization import Localization, Localizer, Seconds
from slimsfm.localization.cameras import QueryCamera
from slimsfm.pose import refine_pose
from slimsfm.tracking.templates import GrayFrame
from slimsfm.tracking.track import MAX_CORNER_ERROR, Track

_MAX_ERROR_PX = 6.0  # of a point that supports the second pose
_MIN_ERROR_PX = 0.25  # to expect of a right pose
_FITS = 2.0  # times the error of the first pose, within which the second one cannot be ruled out
_UNSURE = "the pose is not sure enough to begin a track"
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

    def localize(self, frame_index: int, image: Image, camera: QueryCamera) -> Localization:
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
        # an estimated focal length leaves the distance uncertain, which is no second pose
        exact = found.camera_estimated or (found.predicted_corner_error or 0.0) <= MAX_CORNER_ERROR
        if sure and exact:
            return found
        return replace(found, pose=None, reason=found.reason or _UNSURE, predicted_corner_error=None)


def _nothing(camera: QueryCamera) -> Localization:
    return Localization(
        pose=None,
        reason="the object is lost, and this frame was not searched",
        camera=camera.camera,
        camera_source=camera.source,
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


_FEW = 0.8  # of the most points seen since the last background localization
_TURNED_DEG = 12.0  # change since then of the direction from the object to the camera


@dataclass(frozen=True, kw_only=True, eq=False)
class BackgroundResult:
    """Result of localizing a tracked frame in the background."""

    localization: Localization
    """Localization of the frame."""

    frame: GrayFrame
    """The frame that was localized."""

    tracked_cam_from_world: pycolmap.Rigid3d
    """Pose of that frame according to the track."""


class BackgroundLocalization:
    """Decides when a frame is localized in the background and when the result is used."""

    def __init__(self, center_in_world: Float64[np.ndarray, "3"], every: int, lag: int) -> None:
        """Set the schedule.

        Args:
            center_in_world: Center of the object.
            every: Largest number of frames from one start to the next.
            lag: Number of frames from a start to the use of its result.
        """
        self._center_in_world, self._every, self._lag = center_in_world, every, lag
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="slimsfm-background")
        self._work: Future[BackgroundResult] | None = None
        self._started, self._started_cam_from_world, self._most_seen = 0, pycolmap.Rigid3d(), 0

    def restart(self, frame_index: int, track: Track) -> None:
        """Discard all work, because a new track begins."""
        self._work = None
        self._note(frame_index, track)

    def start_if_due(self, frame_index: int, track: Track, localize: Callable[[], Localization]) -> None:
        """Start localizing the frame that was just tracked, if it is time and no other is in progress."""
        self._most_seen = max(self._most_seen, len(track.seen.rows))
        if self._work or not self._is_due(frame_index, track):
            return
        self._note(frame_index, track)
        frame, cam_from_world = track.frame, track.pose.cam_from_world
        self._work = self._worker.submit(
            lambda: BackgroundResult(
                localization=localize(), frame=frame, tracked_cam_from_world=cam_from_world
            )
        )

    def result_for(self, frame_index: int) -> BackgroundResult | None:
        """The result to use in this frame, if any; waits for it."""
        if self._work is None or frame_index - self._started < self._lag:
            return None
        work, self._work = self._work, None
        return work.result()

    def _note(self, frame_index: int, track: Track) -> None:
        self._started, self._started_cam_from_world = frame_index, track.pose.cam_from_world
        self._most_seen = len(track.seen.rows)

    def _is_due(self, frame_index: int, track: Track) -> bool:
        turned_deg = _angle_deg(
            *map(self._seen_from, (self._started_cam_from_world, track.pose.cam_from_world))
        )
        few = len(track.seen.rows) < _FEW * self._most_seen
        return few or turned_deg > _TURNED_DEG or frame_index - self._started >= self._every

    def _seen_from(self, cam_from_world: pycolmap.Rigid3d) -> Float64[np.ndarray, "3"]:
        """Direction from the object to the camera; other sides come into sight only as it changes."""
        return cam_from_world.inverse().translation - self._center_in_world


def _angle_deg(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "3"]) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
