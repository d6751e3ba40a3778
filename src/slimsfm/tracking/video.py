"""Frames from a video, a folder of images or a camera, and back into a video.

Videos need PyAV, which the extra `video` installs.
"""

from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np

from slimsfm.arrays import Image
from slimsfm.errors import InputError, OutputError
from slimsfm.files import replacing
from slimsfm.photos import list_images, read_image

FORMATS = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska"}
"""Videos that can be written, by suffix."""

_USUAL_RATE = 30.0  # frames a second, where nobody tells
_QUALITY = {"crf": "20", "preset": "veryfast"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One picture of several."""

    name: str
    """Its index, or the name of its file."""

    image: Image
    """Upright RGB."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """Frames in the order in which they were taken."""

    pictures: Generator[Frame]
    """The frames; closed, it lets go of the file or camera."""

    count: int | None
    """How many there are; None where that is not known beforehand."""

    frames_per_second: float
    """At which they were taken; 30 where that is unknown."""

    is_live: bool
    """Whether they come from a camera and go on until somebody stops them."""


def open_frames(source: str) -> Frames:
    """Open a video file, a folder of images, or a camera by its index.

    Raises:
        InputError: There is no such file, folder or camera, or it holds no picture.
    """
    path = Path(source)
    if path.is_dir():
        names = list_images(path)
        return Frames(
            pictures=_images(path, names), count=len(names), frames_per_second=_USUAL_RATE, is_live=False
        )
    if source.isdigit() and not path.exists():
        return _open_camera(int(source))
    return _open_video(path)


def _images(folder: Path, names: list[str]) -> Generator[Frame]:
    for name in names:
        yield Frame(name=name, image=read_image(folder / name))


def _open_camera(index: int) -> Frames:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(index)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        raise InputError(f"{index}: no camera of this index can be opened, and there is no such file")
    rate = capture.get(cv2.CAP_PROP_FPS)
    return Frames(
        pictures=_captured(capture),
        count=None,
        frames_per_second=rate if rate > 0 else _USUAL_RATE,
        is_live=True,
    )


def _captured(capture) -> Generator[Frame]:
    try:
        index = 0
        while True:
            there, bgr = capture.read()
            if not there:
                return
            yield Frame(name=_name(index), image=np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8))
            index += 1
    finally:
        capture.release()


def _open_video(path: Path) -> Frames:
    av = _av()
    try:
        container = av.open(str(path))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such video") from error
    except (av.error.FFmpegError, OSError) as error:
        raise InputError(f"{path}: not a readable video") from error
    if not container.streams.video:
        container.close()
        raise InputError(f"{path}: holds no pictures")
    stream = container.streams.video[0]
    return Frames(
        pictures=_decoded(path, container),
        count=stream.frames or None,
        frames_per_second=float(stream.average_rate or _USUAL_RATE),
        is_live=False,
    )


def _decoded(path: Path, container) -> Generator[Frame]:
    with container:
        stream, index = container.streams.video[0], 0
        stream.thread_type = "AUTO"
        try:
            for index, frame in enumerate(container.decode(stream)):
                image = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90))
                yield Frame(name=_name(index), image=np.ascontiguousarray(image))
        except _av().error.FFmpegError as error:
            raise InputError(f"{path}: cannot be decoded beyond frame {index}") from error


def _name(index: int) -> str:
    return f"{index:06d}"


def check_format(path: Path) -> None:
    """Refuse, before any work is done, a video that cannot be written.

    Raises:
        OutputError: The suffix is of no format that can be written.
        InputError: PyAV is not installed.
    """
    if path.suffix not in FORMATS:
        raise OutputError(f"{path}: videos are written as {', '.join(FORMATS)}")
    _av()


@contextmanager
def write_video(
    path: Path, frames_per_second: float, *, overwrite: bool = False
) -> Iterator[Callable[[Image], None]]:
    """Write pictures of one size, RGB, as a video (H.264); call what is given with one after the other.

    Raises:
        OutputError: The suffix is of no format that can be written, or the file cannot be.
        InputError: PyAV is not installed.
    """
    check_format(path)
    with (
        replacing(path, overwrite=overwrite) as partial,
        _av().open(str(partial), "w", format=FORMATS[path.suffix]) as container,
    ):
        stream = None

        def write(image: Image) -> None:
            nonlocal stream
            even = np.pad(image, [(0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)], "edge")
            if stream is None:
                stream = container.add_stream("libx264", Fraction(frames_per_second).limit_denominator(1001))
                stream.height, stream.width = even.shape[:2]
                stream.pix_fmt, stream.options = "yuv420p", _QUALITY
            frame = _av().VideoFrame.from_ndarray(even, format="rgb24")
            container.mux(stream.encode(frame))

        yield write
        if stream is not None:
            container.mux(stream.encode(None))


def _av() -> ModuleType:
    try:
        import av
    except ImportError as error:
        raise InputError("videos need PyAV: pip install 'slimsfm[video]'") from error
    return av
