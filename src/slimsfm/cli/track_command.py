"""`slimsfm track`."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from slimsfm.cli.arguments import Networks
from slimsfm.cli.options import Advanced, Argument, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish, plural
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.cameras import read_camera
from slimsfm.localization.pose_files import write_poses, writer_for
from slimsfm.mapping.io import read_map
from slimsfm.report.frames import track_video
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
    overwrite: bool = False,
) -> None:
    """Track an object through a video and write the camera pose of every frame.

    Args:
        map: A map.
        source: A video file, a folder of images, or a camera by its index, such as 0, until Ctrl-C.
        output: Poses as .json, .csv, .txt (TUM) or images.txt (COLMAP).
        video: Write the video with the object's box. The fainter the box, the less sure the pose.
        camera: Intrinsics of the frames in COLMAP's cameras.txt format. Without it, those of the map or from
            EXIF are used.
        tracker: How to track.
        localization: How to localize.
        networks: Where learned methods run.
        overwrite: Replace existing outputs.
    """
    watch = Stopwatch()
    networks.apply()
    for path in (output, video) if video else (output,):
        check_output(path, map, Path(source), camera, overwrite=overwrite)
    writer_for(output)
    if video:
        check_format(video)
    given = read_camera(camera) if camera else None
    localizer = Localizer(read_map(map), localization)
    results = track_video(
        localizer, source, tracker, camera=given, video=video, overwrite=overwrite, progress=_shown
    )
    write_poses(output, {name: one.localization for name, one in results.items()}, overwrite=overwrite)
    _sum_up(output, list(results.values()))
    finish(f"{video or output}: {plural(len(results), 'frame')}", watch)


def _shown(frames: FrameSource) -> Iterator[VideoFrame]:
    """The frames, with a bar and their rate on standard error."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task("track", total=frames.count)
        for frame in frames.pictures:
            yield frame
            bars.update(task, advance=1, description=f"track {bars.tasks[0].speed or 0:.0f}/s")


def _sum_up(output: Path, results: Sequence[Tracked]) -> None:
    number = {state: sum(one.state == state for one in results) for state in ("tracked", "localized", "lost")}
    rate = len(results) / sum(one.seconds for one in results)
    console.print(
        f"{output}: {plural(number['tracked'], 'frame')} tracked, {number['localized']} localized from "
        f"scratch, {number['lost']} lost; {rate:.0f} frames per second"
    )
