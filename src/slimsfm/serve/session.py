"""One client that is tracked: from its frames to the answers. Needs no network."""

from dataclasses import dataclass
from time import perf_counter

import pycolmap

from slimsfm.arrays import Image
from slimsfm.localization.cameras import QueryCamera, guess_camera
from slimsfm.localization.map_cameras import scaled_camera
from slimsfm.photos import upright
from slimsfm.serve.images import image_file, read_upright_or_stored
from slimsfm.serve.maps import MapStore, ServedMap
from slimsfm.serve.messages import Frame, Hello
from slimsfm.serve.queries import Intrinsics
from slimsfm.serve.replies import Json, localization_reply
from slimsfm.tracking import Tracked, Tracker, TrackerOptions


@dataclass(frozen=True, kw_only=True, eq=False)
class _Following:
    """A map and the tracker of its object."""

    served: ServedMap
    tracker: Tracker


class TrackingSession:
    """Tracks one of several objects for a client: the last one found, else one after the other.

    A map that was replaced is used from the next frame on. Frames must come one at a time.
    """

    def __init__(self, store: MapStore, hello: Hello, options: TrackerOptions) -> None:
        """Begin to track.

        Raises:
            ApiError: A map is unknown (404) or the intrinsics are impossible (422).
        """
        self._store, self._options = store, options
        self._ids = [one.id for one in store.select(hello.maps)]
        self._given = (
            hello.camera.camera(hello.width, hello.height) if isinstance(hello.camera, Intrinsics) else None
        )
        self._believes_map = hello.camera == "map"
        self._following: dict[str, _Following] = {}
        self._turn = 0

    @property
    def maps(self) -> list[ServedMap]:
        """The maps that are searched."""
        return [self._store[key] for key in self._ids]

    def track(self, frame: Frame) -> Json:
        """Answer a frame.

        Raises:
            ApiError: The picture cannot be used.
        """
        start = perf_counter()
        following = self._followed()
        with image_file(frame.jpeg) as path:
            image = read_upright_or_stored(path, "stored").image
        if following.served.localizer.map.info.orientation == "upright":
            image = upright(image, frame.orientation)
        decoded = perf_counter()
        found = following.tracker.track(image, self._camera(image))
        if found.pose is None:
            self._turn += 1  # another map may have the next frame
        ms = {"decode": decoded - start, "track": perf_counter() - decoded}
        return self._reply(following.served, frame, found, ms)

    def _followed(self) -> _Following:
        served = self._store[self._ids[self._turn % len(self._ids)]]
        known = self._following.get(served.id)
        if known is None or known.served is not served:
            known = _Following(served=served, tracker=Tracker(served.localizer, self._options))
            self._following[served.id] = known
        return known

    def _camera(self, image: Image) -> QueryCamera | pycolmap.Camera | None:
        """The intrinsics of a frame; those given are scaled, and unknown for frames of another shape."""
        if self._believes_map:
            return None
        height, width = image.shape[:2]
        scaled = scaled_camera(self._given, width, height) if self._given else None
        return scaled or QueryCamera(camera=guess_camera(width, height), source="unknown")

    @staticmethod
    def _reply(served: ServedMap, frame: Frame, found: Tracked, seconds: dict[str, float]) -> Json:
        return {
            "type": "pose",
            "sequence": frame.sequence,
            "captured": frame.captured,
            "state": found.state,
            **localization_reply(served, found.localization),
            "ms": {stage: round(1e3 * value, 3) for stage, value in seconds.items()},
        }
