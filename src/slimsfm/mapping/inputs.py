"""What a map is built from: folders of photos and videos, several of either, as one folder of photos."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

from slimsfm.errors import InputError
from slimsfm.files import plain, remove
from slimsfm.film import pyav
from slimsfm.image_files import is_image
from slimsfm.mapping.frames import FRAMES_PER_SECOND, ChosenFrames, extract_frames
from slimsfm.mapping.known_poses.given import Unit
from slimsfm.mapping.workspace import write_whole
from slimsfm.progress import ProgressBar, silent

_PHOTOS, _VIDEOS = "photos", "videos"
_CLAIM = "build.inputs"  # tells a folder of work from others, see `files.resumable`


@dataclass(frozen=True, kw_only=True)
class InputOptions:
    """How frames of videos are chosen, and poses that are known."""

    fps: float = FRAMES_PER_SECOND
    """Frames of a video per second of motion: the sharpest, if the picture has changed since the last one."""

    poses: Path | None = None
    """Known poses: transforms.json (nerfstudio, instant-ngp), a COLMAP model, OnePose's folder of a sequence,
    a trajectory of TUM or poses of KITTI. Points are triangulated from them; frame and unit stay. Photos
    without a pose are left out."""

    unit: Unit | None = None
    """Unit of the known poses. Default: metre if the file is of device poses, otherwise unknown."""

    refine: bool = False
    """Adjust the known poses slightly to the matches, by bundle adjustment in their frame and unit."""

    def __post_init__(self) -> None:
        if not 0 < self.fps < float("inf"):
            raise ValueError(f"fps must be positive, got {self.fps}")
        for name in ("unit", "refine"):
            if getattr(self, name) and self.poses is None:
                raise ValueError(f"{name} is about known poses, and poses are not given")


@dataclass(frozen=True, kw_only=True, eq=False)
class GatheredPhotos:
    """A folder of all photos."""

    folder: Path
    """The folder: the only one that was given, or one with a link to each and the frames of each video."""

    label: str
    """What was given, for messages."""

    seconds: Mapping[str, float] = field(default_factory=dict)
    """When frames of videos are shown, by name."""

    notes: tuple[str, ...] = ()
    """A sentence for each video."""


def gather_photos(
    sources: Sequence[Path],
    workspace: Path,
    *,
    fps: float | int = FRAMES_PER_SECOND,
    strict: bool = False,
    progress: ProgressBar = silent,
) -> GatheredPhotos:
    """Make one folder of photos from folders and videos.

    A single folder stays as it is. Otherwise the photos of a folder are named FOLDER/..., the frames of a
    video VIDEO/000123.png, without the suffix of the video; a name that is taken gets a number. Frames are
    kept in the workspace: an interrupted build does not read its finished videos again.

    Args:
        sources: Folders and videos.
        workspace: An existing folder for the frames.
        fps: See `InputOptions.fps`.
        strict: Stop at a video that cannot be read to its end.
        progress: Progress callback.

    Raises:
        InputError: A source is missing, no video or given twice, or nothing was given.
        VideoError: With `strict`, a video cannot be read to its end.
    """
    _check_sources(sources)
    label = ", ".join(map(str, sources))
    if len(sources) == 1 and not sources[0].is_file():
        return GatheredPhotos(folder=sources[0], label=label)
    (workspace / _CLAIM).touch()
    photos, notes, seconds = workspace / _PHOTOS, [], {}
    for folder in (photos, workspace / _VIDEOS):
        folder.mkdir(exist_ok=True)
    named = _named(sources)
    for path in photos.iterdir():
        if path.is_symlink() or path.name not in named:
            remove(path)
    for name, source in named.items():
        if source.is_dir():
            (photos / name).symlink_to(source.absolute(), target_is_directory=True)
            continue
        chosen = _frames(source, name, workspace, fps=fps, strict=strict, progress=progress)
        seconds |= {f"{name}/{frame}": at for frame, at in chosen.seconds.items()}
        notes.append(
            f"{source.name}: {len(chosen.seconds)} of {chosen.num_read} frames used, sharp and new ones"
        )
        if chosen.ended_early:
            notes.append(f"{chosen.ended_early}; its frames until there are used")
    return GatheredPhotos(folder=photos, label=label, seconds=seconds, notes=tuple(notes))


def _check_sources(sources: Sequence[Path]) -> None:
    if not sources:
        raise InputError("nothing to build a map from: give folders of photos or videos")
    seen = set()
    for source in sources:
        if os.path.realpath(source) in seen:
            raise InputError(f"{source}: is given twice")
        seen.add(os.path.realpath(source))
        if source.is_file() and is_image(source):
            raise InputError(f"{source}: is a single image; give the folder of the photos, or a video")
        if not source.exists() and (source.suffix or len(sources) > 1):
            raise InputError(f"{source}: no such folder of images and no such video")


def _named(sources: Sequence[Path]) -> dict[str, Path]:
    """Each source by the name that its images begin with, in the order given."""
    named: dict[str, Path] = {}
    for source in sources:
        path = Path(os.path.abspath(source))
        stem = (path.name if source.is_dir() else path.stem) or "photos"
        number, name = 2, stem
        while name in named:
            number, name = number + 1, f"{stem}-{number}"
        named[name] = source
    return named


def _frames(
    video: Path, name: str, workspace: Path, *, fps: float | int, strict: bool, progress: ProgressBar
) -> ChosenFrames:
    """Choose the frames of a video, unless an interrupted build has done so."""
    folder, record, found = workspace / _PHOTOS / name, workspace / _VIDEOS / f"{name}.json", video.stat()
    key = [os.path.realpath(video), found.st_size, found.st_mtime_ns, fps, version("slimsfm")]
    key.append(pyav().__version__)
    before = _recorded(record, key, folder)
    if before is not None and not (strict and before.ended_early):
        return before
    for path in (record, folder):
        remove(path)
    chosen = extract_frames(video, folder, fps=fps, strict=strict, progress=progress)
    data = {"num_read": chosen.num_read, "ended_early": chosen.ended_early, "seconds": dict(chosen.seconds)}
    write_whole(record, json.dumps({"key": key, "frames": data}).encode())
    return chosen


def _recorded(record: Path, key: list, folder: Path) -> ChosenFrames | None:
    try:
        data = json.loads(record.read_text())
        chosen = plain(data["frames"], ChosenFrames) if data["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return chosen if chosen and all((folder / name).is_file() for name in chosen.seconds) else None
