"""Speed, accuracy and reliability of tracking an object, against localizing each frame on its own.

    python benchmarks/tracking.py -o /tmp/scenes

The film of `film_frames.py` is encoded as a video and tracked on the full map and on a reduced one, from
decoding to pose. The same decoded frames are localized one by one, on the full map, against every reference
image. The output folder stores the film, its map, the reduced map and, with --draw, the video with the box of
the object. Figures with a target show it.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import pycolmap
from jaxtyping import Float64

from benchmark_scenes import rendered
from film import FRAMES_PER_SECOND
from film_frames import NAME, FilmFrames, film_frames
from slimsfm.arrays import Image
from slimsfm.cli import run
from slimsfm.geometry import Box, corner_error
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.mapping import Map, read_map
from slimsfm.photos import read_image
from slimsfm.pose import PoseEstimate
from slimsfm.progress import shown
from slimsfm.report.frames import ESTIMATED_RGB, draw_box
from slimsfm.tracking import Tracked, Tracker, TrackerOptions
from slimsfm.tracking.video import open_frames, write_video

RIGHT = 0.1  # corner error, over the diagonal
WANTED_FPS, WANTED_BACK = 30.0, 10


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """Outcome of each frame."""

    results: list[Tracked]
    errors: Float64[np.ndarray, " frames"]
    """Relative corner errors; infinite without a pose."""

    seconds: Float64[np.ndarray, " frames"]
    """Time from requesting a frame from the decoder to its pose."""

    cpu_seconds: float
    """CPU time of all threads."""


def main() -> None:
    """Prepare missing files, track and print."""
    arguments = parsed()
    film = film_frames(arguments.film or arguments.output / "film")
    video = encoded(film, arguments.output / "film.mp4")
    full = arguments.output / f"{NAME}-map"
    if not full.exists():
        rendered(NAME, arguments.output)
    print(f"{len(film.visible)} frames, wholly hidden {len(film.occlusion)}, one cut; {video}")
    alone = None if arguments.no_exhaustive else each_alone(film, video, read_map(full))
    if alone is not None:
        print(f"each alone, exhaustive: {accuracy(alone, film)}")
    for name, path in (("full", full), ("slim", arguments.slim or slim_map(full, arguments.output))):
        map_ = read_map(path)
        ran = tracked(film, video, map_, TrackerOptions(smoothing=arguments.smoothing))
        show(name, ran, film, alone)
        if arguments.draw:
            draw(video, ran, film, map_.box, arguments.output / f"tracked-{name}.mp4")
        if arguments.verbose:
            list_frames(ran, film)


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--film", type=Path, help="folder of the film's frames, if not OUTPUT/film")
    parser.add_argument("--slim", type=Path, help="slim map, if not OUTPUT/NAME-slim")
    parser.add_argument("--smoothing", type=float, default=0.0)
    parser.add_argument("--no-exhaustive", action="store_true", help="track only")
    parser.add_argument("--draw", action="store_true", help="write the videos with the box drawn in")
    parser.add_argument("--verbose", action="store_true", help="list frames of interest")
    return parser.parse_args()


def encoded(film: FilmFrames, path: Path) -> Path:
    """The film as a video file."""
    if not path.exists():
        with write_video(path, FRAMES_PER_SECOND) as write:
            for image_path in shown(film.sequence.image_paths, "encode"):
                write(read_image(image_path))
    return path


def slim_map(full: Path, output: Path) -> Path:
    """The full map, reduced with the defaults of `slimsfm reduce`."""
    path = output / f"{NAME}-slim"
    if not path.exists() and run(["reduce", str(full), "-o", str(path)]):
        raise SystemExit(1)
    return path


def images_of(video: Path) -> Iterator[Image]:
    """Decoded frames."""
    return (frame.image for frame in open_frames(str(video)).pictures)


def truth_of(film: FilmFrames) -> list[pycolmap.Rigid3d]:
    """True poses, frame by frame."""
    return list(film.sequence.cam_from_world)


def error_of(pose: PoseEstimate | None, true_cam_from_world: pycolmap.Rigid3d, box: Box) -> float:
    """Relative corner error; infinite without a pose."""
    return np.inf if pose is None else corner_error(pose.cam_from_world, true_cam_from_world, box)


def each_alone(film: FilmFrames, video: Path, full: Map) -> Float64[np.ndarray, " frames"]:
    """Errors of localizing each frame against every reference image."""
    localizer = Localizer(full, LocalizationOptions(strategy="exhaustive"))
    pairs = list(zip(images_of(video), truth_of(film), strict=True))
    return np.array(
        [
            error_of(localizer.localize(image, film.sequence.cameras[0]).pose, truth, full.box)
            for image, truth in shown(pairs, "each alone")
        ]
    )


def tracked(film: FilmFrames, video: Path, map_: Map, options: TrackerOptions) -> Run:
    """Track the video; at the first frame, only the localizer is initialized."""
    tracker = Tracker(Localizer(map_), options)
    results, seconds, cpu = [], [], process_time()
    last = perf_counter()
    for image in images_of(video):
        results.append(tracker.track(image, film.sequence.cameras[0]))
        now = perf_counter()
        seconds.append(now - last)
        last = now
    errors = [error_of(one.pose, truth, map_.box) for one, truth in zip(results, truth_of(film), strict=True)]
    return Run(
        results=results,
        errors=np.array(errors),
        seconds=np.array(seconds),
        cpu_seconds=process_time() - cpu,
    )


def accuracy(errors: Float64[np.ndarray, " frames"], film: FilmFrames) -> str:
    """Shares of correct poses with the object in view, and the number of poses without it."""
    seen = film.visible > 0
    shares = ", ".join(f"ADD-{limit}d {add(errors, film, limit):.2f} %" for limit in (0.1, 0.05, 0.02))
    median = np.median(errors[seen & np.isfinite(errors)])
    return (
        f"{shares}, median {median:.4f}d, wrong {np.sum(seen & np.isfinite(errors) & (errors >= RIGHT))}, "
        f"poses of nothing {np.sum(~seen & np.isfinite(errors))}"
    )


def add(
    errors: Float64[np.ndarray, " frames"], film: FilmFrames, limit: float, in_sight: float = 0.0
) -> float:
    """Percentage of frames with an error below a limit, if more than this share of the object is in view."""
    return 100 * float(np.mean(errors[film.visible > in_sight] < limit))


def back(errors: Float64[np.ndarray, " frames"], since: int) -> float:
    """Number of frames until the first correct pose; 0 if the first frame has one."""
    right = np.flatnonzero(errors[since:] < RIGHT)
    return float(right[0]) if len(right) else np.inf


def show(name: str, ran: Run, film: FilmFrames, alone: Float64[np.ndarray, " frames"] | None) -> None:
    """Print figures and targets."""
    states = np.array([one.state for one in ran.results])
    steady = ran.seconds[states == "tracked"]
    false = np.sum(np.isfinite(ran.errors) & ((film.visible == 0) | (ran.errors >= RIGHT)))
    counts = ", ".join(f"{np.sum(states == state)} {state}" for state in ("tracked", "localized", "lost"))
    print(f"{name} map: {counts}; {1e3 * ran.cpu_seconds / len(states):.1f} ms of CPU a frame")
    against = "" if alone is None else f"target: at least {add(alone, film, RIGHT):.2f} %"
    lines = [
        ("frames a second, overall", f"{len(states) / ran.seconds.sum():.1f}", f"target: {WANTED_FPS:.0f}"),
        ("  in steady state", f"{1 / steady.mean():.1f} (median {1 / np.median(steady):.1f})", ""),
        ("ADD-0.1d", f"{add(ran.errors, film, RIGHT):.2f} %", against),
        ("  where at least half is in sight", f"{add(ran.errors, film, RIGHT, 0.5):.2f} %", ""),
        ("frames until back, cut", f"{back(ran.errors, film.cut):.0f}", f"target: {WANTED_BACK}"),
        ("  occlusion", f"{back(ran.errors, film.occlusion.stop):.0f}", f"target: {WANTED_BACK}"),
        ("poses while out of sight, or wrong", str(false), "target: 0"),
    ]
    for label, figure, target in lines:
        print(f"  {label:36}{figure:24}{target}")
    print(f"  {accuracy(ran.errors, film)}")


def list_frames(ran: Run, film: FilmFrames) -> None:
    """Print the frames that were not tracked, or badly."""
    for index, (one, error) in enumerate(zip(ran.results, ran.errors, strict=True)):
        if one.state != "tracked" or error > 0.02 or film.visible[index] < 0.8:
            confidence = one.pose.confidence if one.pose else None
            print(
                f"    {index:4} {one.state:10}{one.num_points:4} points, error {error:.4f}, visible "
                f"{film.visible[index]:.2f}, confidence {confidence}, {1e3 * ran.seconds[index]:.0f} ms"
            )


def draw(video: Path, ran: Run, film: FilmFrames, box: Box, path: Path) -> None:
    """Write the video with the estimated box."""
    with write_video(path, FRAMES_PER_SECOND, overwrite=True) as write:
        for image, one in zip(images_of(video), ran.results, strict=True):
            drawn = image.copy()
            if one.pose:
                pose, camera = one.pose.cam_from_world, film.sequence.cameras[0]
                draw_box(drawn, box, pose, camera, ESTIMATED_RGB, thickness=2)
            write(drawn)


if __name__ == "__main__":
    main()
