"""Tracking an object through a video, and the video with the object's box drawn in."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from slimsfm.arrays import Image
from slimsfm.errors import InputError, VideoError
from slimsfm.files import uninterrupted
from slimsfm.geometry import Box
from slimsfm.localization import Localizer
from slimsfm.localization.cameras import QueryCamera, camera_in_memory, query_camera, scaled_camera
from slimsfm.report.frames import TRUE_RGB, draw_box
from slimsfm.tracking import Tracked, Tracker, TrackerOptions
from slimsfm.tracking.video import FrameSource, VideoFrame, open_frames, write_video

FrameProgress = Callable[[FrameSource], Iterator[VideoFrame]]
"""Yields the frames unchanged and may show how many are done."""

_FAINTEST = 0.2  # opacity of the box under a pose that cannot be trusted


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedVideo:
    """Result of tracking an object through a video."""

    frames: dict[str, Tracked]
    """The outcome of each frame, by the name of the frame, in the order of the frames."""

    skipped: Mapping[str, str] = field(default_factory=dict)
    """Why images of a folder were skipped, by name."""

    ended_early: str | None = None
    """Why the video could not be read to its end; None where it was."""


def track_video(
    localizer: Localizer,
    source: str | Path,
    options: TrackerOptions = TrackerOptions(),
    *,
    camera: pycolmap.Camera | None = None,
    video: str | Path | None = None,
    overwrite: bool = False,
    strict: bool = False,
    progress: FrameProgress = lambda frames: frames.pictures,
) -> TrackedVideo:
    """Track an object through all frames of a video.

    An interruption ends the frames of a live camera, damage or a change of size those of a video file, and
    what was tracked is returned. Images of a folder that cannot be read or have another size than the first
    are skipped.

    Args:
        localizer: Localizer of the map.
        source: A video file, a folder of images, or a camera by its index.
        options: How to track.
        camera: Intrinsics of the frames, chosen as by `query_camera` if not given. What is estimated with the
            first pose is kept.
        video: Where to write the video with the object's box. The fainter the box, the less sure the pose.
        overwrite: Whether to replace an existing `video`.
        strict: Whether an image that cannot be used or a video that cannot be read to its end is an error.
        progress: Progress callback.

    Returns:
        The outcome of each frame.

    Raises:
        InputError: The source cannot be read or has no frame, its focal length must be known but is not; or,
            if `strict`, an image or the end of the video cannot be read.
        OutputError: The video cannot be written.
    """
    source, tracker = str(source), Tracker(localizer, options)
    frames = open_frames(source, localizer.map.info.orientation, strict=strict)
    rate = frames.frames_per_second
    with write_video(Path(video), rate, overwrite=overwrite) if video else nullcontext() as write:
        return _track_all(localizer, tracker, source, frames, camera, write, progress, strict=strict)


def draw_tracked(image: Image, tracked: Tracked, box: Box) -> Image:
    """Draw the box of the object into a frame, with the confidence of the pose as opacity.

    Returns:
        A copy of the image; the image itself where the object is lost.
    """
    if tracked.pose is None:
        return image
    boxed = image.copy()
    thickness = max(2, round(max(image.shape) / 320))
    camera = tracked.localization.camera
    draw_box(boxed, box, tracked.pose.cam_from_world, camera, TRUE_RGB, thickness=thickness)
    confidence = tracked.pose.confidence
    opacity = 1.0 if confidence is None else max(confidence, _FAINTEST)
    return np.asarray(cv2.addWeighted(boxed, opacity, image, 1 - opacity, 0), np.uint8)


def _track_all(
    localizer: Localizer,
    tracker: Tracker,
    source: str,
    frames: FrameSource,
    given: pycolmap.Camera | None,
    write: Callable[[Image], None] | None,
    progress: FrameProgress,
    *,
    strict: bool,
) -> TrackedVideo:
    """Track and write frame by frame.

    A frame of a live camera is finished before an interruption: poses and video end with the same frame.
    """
    results: dict[str, Tracked] = {}
    camera, ended_early = None, None
    try:
        for frame in progress(frames):
            camera = camera or _camera_of(localizer, source, frame, given)
            with uninterrupted() if frames.is_live else nullcontext():
                tracked = replace(tracker.track(frame.image, camera), frame_seconds=frame.seconds)
                results[frame.name] = tracked
                if write:
                    write(draw_tracked(frame.image, tracked, localizer.map.box))
    except VideoError as error:
        if strict or not results:
            raise
        ended_early = str(error)
    except KeyboardInterrupt:
        if not (frames.is_live and results):
            raise
    if not results:
        raise InputError("the video has no frames")
    skipped = frames.skipped.reasons if frames.skipped else {}
    return TrackedVideo(frames=results, skipped=skipped, ended_early=ended_early)


def _camera_of(
    localizer: Localizer, source: str, frame: VideoFrame, given: pycolmap.Camera | None
) -> QueryCamera:
    """The intrinsics of all frames, from the first, in the order of `query_camera`."""
    focal = localizer.options.focal
    if Path(source).is_dir():
        return query_camera(localizer.map, Path(source) / frame.name, given, focal)
    height, width = frame.image.shape[:2]
    scaled = given and scaled_camera(given, width, height)
    if given and scaled is None:
        raise InputError(
            f"{source}: {width}x{height} pixels, but the given camera has {given.width}x{given.height}; "
            "give `camera=FILE` of this video"
        )
    found = camera_in_memory(localizer.map, width, height, scaled)
    if found.source == "unknown" and focal == "known":
        raise InputError(
            f"{source}: {width}x{height} pixels, focal length unknown; give `camera=FILE` of this video"
        )
    return found
