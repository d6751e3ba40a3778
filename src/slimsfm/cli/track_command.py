"""`slimsfm track`."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Networks, Reading
from slimsfm.cli.options import Advanced, Argument, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish, plural
from slimsfm.localization import Localization, LocalizationOptions, Localizer
from slimsfm.localization.cameras import read_camera
from slimsfm.localization.pose_files import write_poses, writer_for
from slimsfm.mapping.io import read_map
from slimsfm.progress import counted, shown
from slimsfm.report.tracked_video import track_video
from slimsfm.tracking import Tracked, TrackerOptions
from slimsfm.tracking.video import FrameSource, VideoFrame, check_format

VideoPath = Annotated[str, Argument("VIDEO")]


def track(
    map: MapPath,
    source: VideoPath,
    /,
    output: OutputPath,
    video: Path | None = None,
    camera: Path | None = None,
    tracker: Annotated[TrackerOptions, Advanced()] = TrackerOptions(),
    localization: Annotated[LocalizationOptions, Advanced()] = LocalizationOptions(),
    networks: Annotated[Networks, Advanced()] = Networks(),
    strict: bool = False,
    reading: Annotated[Reading, Advanced()] = Reading(),
    overwrite: bool = False,
) -> None:
    """Track an object through a video and write the camera pose of every frame.

    Args:
        map: A map.
        source: A video file, a folder of images, or a camera by its index, such as 0, until Ctrl-C.
        output: Poses as .json, .csv, .txt (TUM) or images.txt (COLMAP).
        video: Write the video with the object's box. The fainter the box, the less sure the pose.
        camera: Intrinsics of the frames in COLMAP's cameras.txt format. Without it, those of the map where
            size and EXIF fit, else from EXIF; else the focal length is estimated with the first pose.
        tracker: How to track.
        localization: How to localize.
        networks: Where learned methods run.
        strict: Stop at the first frame that cannot be used, and write nothing.
        reading: Limits on what is read.
        overwrite: Replace existing outputs.
    """
    watch = Stopwatch()
    networks.apply()
    reading.apply()
    for path in (output, video) if video else (output,):
        check_output(path, map, Path(source), camera, overwrite=overwrite)
    writer_for(output)
    if video:
        check_format(video)
    given = read_camera(camera) if camera else None
    localizer = Localizer(read_map(map), localization)
    tracked = track_video(
        localizer,
        source,
        tracker,
        camera=given,
        video=video,
        overwrite=overwrite,
        strict=strict,
        progress=_shown,
    )
    frames, orientation = tracked.frames, localizer.map.info.orientation
    poses = {name: one.localization for name, one in frames.items()}
    poses |= {name: Localization.skipped(why, orientation) for name, why in tracked.skipped.items()}
    if tracked.skipped:
        poses = dict(sorted(poses.items()))  # images of a folder are read in this order
    seconds = {name: frames[name].frame_seconds if name in frames else None for name in poses}
    write_poses(output, poses, info=localizer.map.info, seconds=seconds, overwrite=overwrite)
    _sum_up(output, list(frames.values()))
    if tracked.ended_early:
        console.print(f"warning: {tracked.ended_early}", style="bold red")
    left_out = f", {len(tracked.skipped)} skipped" if tracked.skipped else ""
    finish(f"{video or output}: {plural(len(poses), 'frame')}{left_out}", watch)


def _shown(frames: FrameSource) -> Iterator[VideoFrame]:
    """The frames, with progress on standard error: their number, or the time where it is not known."""
    with counted(shown, frames.count or 1, "track") as advance_to:
        for number, frame in enumerate(frames.pictures, start=1):
            yield frame
            advance_to(number if frames.count else 0)
        advance_to(frames.count or 1)


def _sum_up(output: Path, results: Sequence[Tracked]) -> None:
    number = {state: sum(one.state == state for one in results) for state in ("tracked", "localized", "lost")}
    rate = len(results) / sum(one.seconds for one in results)
    console.print(
        f"{output}: {plural(number['tracked'], 'frame')} tracked, {number['localized']} localized from "
        f"scratch, {number['lost']} lost; {rate:.0f} frames per second"
    )
