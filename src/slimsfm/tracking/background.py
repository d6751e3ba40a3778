"""Localization in the background of tracking: it finds points that come into sight and verifies the track.

A frame is handed to another thread, and its result is used a fixed number of frames later: later than
necessary on a fast machine, after waiting on a slow one. So the poses depend on the frames alone.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.localization import Localization
from slimsfm.tracking.gray_frame import GrayFrame
from slimsfm.tracking.track import Track

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
