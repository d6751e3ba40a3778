"""Finding an object that is not being tracked.

To search a whole frame for an object that is not in it takes longest of all. So it is done at once when the
object is lost, and then after ever longer pauses; in the frames between, the object is sought where it was
seen last, where it mostly is when what hid it is gone. When to search is a matter of counting frames: poses
do not depend on how fast the machine is.
"""

from dataclasses import replace

import numpy as np
import pycolmap

from slimsfm.arrays import Image
from slimsfm.localization import Localization, Localizer, Seconds
from slimsfm.tracking.track import MAX_CORNER_ERROR


class Recovery:
    """Seeks an object in frames on their own."""

    def __init__(self, localizer: Localizer, longest_pause: int, min_confidence: float) -> None:
        """Set how much is done.

        Args:
            localizer: Of the object's map.
            longest_pause: Frames from one search of a whole frame to the next, at most.
            min_confidence: A pose less sure than this is not believed.
        """
        self._localizer = localizer
        self._longest_pause = longest_pause
        self._min_confidence = min_confidence
        self._last_cam_from_world: pycolmap.Rigid3d | None = None
        self._next, self._pause = 0, 1

    def lost(self, frame: int, last_cam_from_world: pycolmap.Rigid3d) -> None:
        """Take note that the object was in sight up to this frame, where it is to be searched for at once."""
        self._last_cam_from_world = last_cam_from_world
        self._next, self._pause = frame, 1

    def seek(self, frame: int, image: Image, camera: pycolmap.Camera) -> Localization:
        """Localize a frame, in whole or near where the object was seen last, whichever it is time for."""
        if frame >= self._next:
            self._next = frame + self._pause
            self._pause = min(2 * self._pause, self._longest_pause)
            return self._believed(self._localizer.localize(image, camera))
        if self._last_cam_from_world is None:
            return _nothing(camera)
        return self._believed(self._localizer.localize_near(image, camera, self._last_cam_from_world))

    def _believed(self, found: Localization) -> Localization:
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
