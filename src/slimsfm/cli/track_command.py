"""`slimsfm track`."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pycolmap
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from slimsfm.arrays import Image
from slimsfm.cli.options import Advanced, Argument, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish
from slimsfm.errors import InputError
from slimsfm.files import uninterrupted
from slimsfm.geometry import Box
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.cameras import query_camera, read_camera, scaled_camera
from slimsfm.localization.pose_files import write_poses, writer_for
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from slimsfm.report.frames import TRUE_RGB, draw_box
from slimsfm.tracking import Tracked, Tracker, TrackerOptions
from slimsfm.tracking.video import Frame, Frames, check_format, open_frames, write_video

VideoPath = Annotated[str, Argument("VIDEO")]

_FAINTEST = 0.2  # opacity of the box of a pose that deserves no belief


def track(
    map: MapPath,
    source: VideoPath,
    /,
    output: OutputPath,
    video: Path | None = None,
    tracker: TrackerOptions = TrackerOptions(),
    localization: Annotated[LocalizationOptions, Advanced(("matching", "ransac"))] = LocalizationOptions(),
    camera: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Follow an object through a video.

    Args:
        map: A map.
        source: A video file, a folder of images, or a camera by its index, such as 0, until Ctrl-C.
        output: Poses as .json, .csv, .txt (TUM) or images.txt (COLMAP).
        video: Write the video with the object's box drawn in, fainter where the pose is less sure.
        tracker: How to track.
        localization: How to localize.
        camera: Intrinsics of the frames, in COLMAP's cameras.txt format; else the map's or EXIF's.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    if localization.focal != "known":
        raise InputError("tracking needs a known focal length; leave out --focal and give --camera FILE")
    for path in (output, video) if video else (output,):
        for made_of in (map, Path(source)):
            check_output(path, made_of, overwrite=overwrite)
    writer_for(output)
    if video:
        check_format(video)
    given = read_camera(camera) if camera else None
    map_, frames = read_map(map), open_frames(source)
    follower = Tracker(Localizer(map_, localization), tracker)
    drawing = write_video(video, frames.frames_per_second, overwrite=overwrite) if video else nullcontext()
    with drawing as write:
        results = _follow(
            frames, follower, lambda frame: _camera(map_, source, frame, given), map_.box, write
        )
    write_poses(output, {name: one.localization for name, one in results.items()}, overwrite=overwrite)
    _sum_up(output, list(results.values()))
    finish(f"{video or output}: {len(results)} frames", watch, "info", map)


def _follow(
    frames: Frames,
    tracker: Tracker,
    camera_of: Callable[[Frame], pycolmap.Camera],
    box: Box,
    write: Callable[[Image], None] | None,
) -> dict[str, Tracked]:
    """Track all frames, and draw them if there is somebody to write them; Ctrl-C ends a camera's.

    A frame of a camera that was begun is finished first, so that poses and video end with the same one.
    """
    results: dict[str, Tracked] = {}
    camera = None
    try:
        for frame in _shown(frames):
            camera = camera or camera_of(frame)
            _check_size(frame, camera)
            with uninterrupted() if frames.is_live else nullcontext():
                results[frame.name] = tracker.track(frame.image, camera)
                if write:
                    write(_drawn(frame.image, results[frame.name], box, camera))
    except KeyboardInterrupt:
        if not (frames.is_live and results):
            raise
    if not results:
        raise InputError("the video holds no frame")
    return results


def _shown(frames: Frames) -> Iterator[Frame]:
    """The frames, with a bar and their rate on standard error."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task("track", total=frames.count)
        for frame in frames.pictures:
            yield frame
            bars.update(task, advance=1, description=f"track {bars.tasks[0].speed or 0:.0f}/s")


def _camera(map: Map, source: str, frame: Frame, given: pycolmap.Camera | None) -> pycolmap.Camera:
    """The intrinsics of all frames, told by the first: given, of the map, or EXIF's."""
    if Path(source).is_dir():
        return query_camera(map, Path(source) / frame.name, given)
    height, width = frame.image.shape[:2]
    known = given or map.shared_camera
    camera = known and scaled_camera(known, width, height)
    if camera is None:
        whose = f"is not of --camera {given.width}x{given.height}" if given else "has an unknown focal length"
        raise InputError(f"{source}: {width}x{height} pixels, {whose}; give --camera FILE of this video")
    return camera


def _check_size(frame: Frame, camera: pycolmap.Camera) -> None:
    height, width = frame.image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"frame {frame.name} has {width}x{height} pixels, the first {camera.width}x{camera.height}; "
            "frames must be of one size"
        )


def _drawn(image: Image, tracked: Tracked, box: Box, camera: pycolmap.Camera) -> Image:
    """The frame with the object's box; none where it is lost."""
    if tracked.pose is None:
        return image
    boxed = image.copy()
    thickness = max(2, round(max(image.shape) / 320))
    draw_box(boxed, box, tracked.pose.cam_from_world, camera, TRUE_RGB, thickness=thickness)
    confidence = tracked.pose.confidence
    opacity = 1.0 if confidence is None else max(confidence, _FAINTEST)
    return np.asarray(cv2.addWeighted(boxed, opacity, image, 1 - opacity, 0), np.uint8)


def _sum_up(output: Path, results: Sequence[Tracked]) -> None:
    number = {state: sum(one.state == state for one in results) for state in ("tracked", "localized", "lost")}
    rate = len(results) / sum(one.seconds for one in results)
    console.print(
        f"{output}: {number['tracked']} frames tracked, {number['localized']} localized on their own, "
        f"{number['lost']} lost; {rate:.0f} frames a second"
    )
