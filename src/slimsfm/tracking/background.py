"""Localizing beside the tracking: new points come into sight, and what is known of old ones ages.

A frame is handed to another thread, and what it finds there is taken over a fixed number of frames later:
later if the machine is fast, by waiting if it is slow. So the poses depend on the frames alone.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.localization import Localization
from slimsfm.tracking.gray_frame import View
from slimsfm.tracking.track import Track

_FEW = 0.8  # of the most points seen since the last renewal
_TURNED_DEG = 12.0  # the direction from the object to the camera, since then


@dataclass(frozen=True, kw_only=True, eq=False)
class Renewed:
    """What was found beside the tracking."""

    localization: Localization
    """Of a frame some frames ago."""

    view: View
    """That frame."""

    tracked_cam_from_world: pycolmap.Rigid3d
    """Its pose as it was tracked."""


class Renewal:
    """Decides when a frame is localized beside the tracking, and when what was found is taken over."""

    def __init__(self, center_in_world: Float64[np.ndarray, "3"], every: int, lag: int) -> None:
        """Set the rhythm.

        Args:
            center_in_world: Middle of the object.
            every: Frames from one to the next, at most.
            lag: Frames from handing over a frame to taking over what was found.
        """
        self._center_in_world, self._every, self._lag = center_in_world, every, lag
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="slimsfm-renewal")
        self._work: Future[Renewed] | None = None
        self._begun, self._begun_cam_from_world, self._most_seen = 0, pycolmap.Rigid3d(), 0

    def restart(self, frame: int, track: Track) -> None:
        """Forget all there was: the track has just begun."""
        self._work = None
        self._note(frame, track)

    def _note(self, frame: int, track: Track) -> None:
        self._begun, self._begun_cam_from_world = frame, track.pose.cam_from_world
        self._most_seen = len(track.seen.rows)

    def begin_if_wanted(self, frame: int, track: Track, localize: Callable[[], Localization]) -> None:
        """Hand over a frame that was just tracked if it is time, unless another is under way."""
        self._most_seen = max(self._most_seen, len(track.seen.rows))
        if self._work or not self._is_wanted(frame, track):
            return
        self._note(frame, track)
        view, cam_from_world = track.view, track.pose.cam_from_world
        self._work = self._worker.submit(
            lambda: Renewed(localization=localize(), view=view, tracked_cam_from_world=cam_from_world)
        )

    def _is_wanted(self, frame: int, track: Track) -> bool:
        turned_deg = _angle_deg(
            *map(self._seen_from, (self._begun_cam_from_world, track.pose.cam_from_world))
        )
        few = len(track.seen.rows) < _FEW * self._most_seen
        return few or turned_deg > _TURNED_DEG or frame - self._begun >= self._every

    def _seen_from(self, cam_from_world: pycolmap.Rigid3d) -> Float64[np.ndarray, "3"]:
        """Direction from the object to the camera: other sides of it come into sight only as this turns."""
        return cam_from_world.inverse().translation - self._center_in_world

    def due(self, frame: int) -> Renewed | None:
        """What is to be taken over in this frame, if anything; waits for it."""
        if self._work is None or frame - self._begun < self._lag:
            return None
        work, self._work = self._work, None
        return work.result()


def _angle_deg(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "3"]) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
