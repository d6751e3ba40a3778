"""Read frames from a video, a folder of images or a camera, and write frames to a video.

Videos need PyAV, which the extra `video` installs.
"""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from itertools import count
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np

from slimsfm.arrays import Image
from slimsfm.errors import ImageError, InputError, OutputError, VideoError
from slimsfm.files import replacing
from slimsfm.image_files import list_images
from slimsfm.photos import Orientation, read_image
from slimsfm.skipping import SkippedPhotos
from slimsfm.tracking.film import film_pictures, open_film, pyav

VIDEO_FORMATS = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska", ".webm": "webm"}
"""Container formats of the videos that can be written, by suffix."""

_DEFAULT_RATE = 30.0  # frames per second, where the source does not say
_H264 = "libx264", {"crf": "20", "preset": "veryfast"}
_VP8 = "libvpx", {"crf": "10", "b": "4M", "deadline": "realtime", "cpu-used": "4"}  # which all browsers play


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoFrame:
    """One frame of a video, a folder or a camera."""

    name: str
    """Index of the frame with six digits, or the name of its file."""

    image: Image
    """RGB."""

    seconds: float | None = None
    """When the frame is shown, as the file says; of a camera, the time since its first frame. None for images
    of a folder and where the file has no times."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameSource:
    """Frames in the order in which they were taken."""

    pictures: Generator[VideoFrame]
    """Generator of the frames, all of one size; closing it releases the file or camera. It ends with a
    `VideoError` where a video is damaged or cut off or changes its size."""

    count: int | None
    """Number of frames; None where it is not known in advance."""

    frames_per_second: float
    """Frame rate of the source; 30 where it is unknown."""

    is_live: bool
    """Whether the frames come from a camera and continue until stopped."""

    skipped: SkippedPhotos | None = None
    """The images of a folder that were skipped so far, because they cannot be used; None if it is none."""


def open_frames(
    source: str | Path, orientation: Orientation = "upright", *, strict: bool = False
) -> FrameSource:
    """Open a video file, a folder of images, or a camera by its index.

    Images are read upright or as they are stored, as `orientation` says; videos are always read as a
    player shows them: in square pixels, rotated and mirrored as the file says. Images of a folder that cannot
    be read or differ in size from the first are skipped with a warning, unless `strict` is set.

    Raises:
        InputError: The file, folder or camera does not exist or contains no image.
    """
    source, path = str(source), Path(source)
    if path.is_dir():
        names, skipped = list_images(path), SkippedPhotos(path, strict=strict)
        return FrameSource(
            pictures=_images(path, names, orientation, skipped),
            skipped=skipped,
            count=len(names),
            frames_per_second=_DEFAULT_RATE,
            is_live=False,
        )
    if source.isdigit() and not path.exists():
        return _open_camera(int(source))
    return _open_video(path)


def _images(
    folder: Path, names: list[str], orientation: Orientation, skipped: SkippedPhotos
) -> Generator[VideoFrame]:
    size = None
    for name in names:
        image = None
        with skipped.skipping(name):
            image = read_image(folder / name, orientation)
            size = size or _size(image)
            if _size(image) != size:
                raise ImageError(f"{folder / name}: has {_size(image)} pixels, the frames before {size}")
        if image is not None and name not in skipped.reasons:
            yield VideoFrame(name=name, image=image)
    skipped.left(names)


def _size(image: Image) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _open_camera(index: int) -> FrameSource:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(index)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        raise InputError(f"{index}: no camera with this index can be opened, and no such file exists")
    rate = capture.get(cv2.CAP_PROP_FPS)
    return FrameSource(
        pictures=_captured(capture),
        count=None,
        frames_per_second=rate if rate > 0 else _DEFAULT_RATE,
        is_live=True,
    )


def _captured(capture) -> Generator[VideoFrame]:
    try:
        start = size = None
        for index in count():
            ok, bgr = capture.read()
            if not ok:
                return
            now = perf_counter()
            start = now if start is None else start
            image = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
            if _size(image) != (size := size or _size(image)):
                raise VideoError(f"the camera changed its frames from {size} to {_size(image)} pixels")
            yield VideoFrame(name=_name(index), image=image, seconds=now - start)
    finally:
        capture.release()


def _open_video(path: Path) -> FrameSource:
    container, stream = open_film(path)
    return FrameSource(
        pictures=_decoded(film_pictures(path, container, stream)),
        count=stream.frames or None,
        frames_per_second=float(stream.average_rate or _DEFAULT_RATE),
        is_live=False,
    )


def _decoded(pictures: Generator[tuple[Image, float | None]]) -> Generator[VideoFrame]:
    with closing(pictures):
        for index, (image, seconds) in enumerate(pictures):
            yield VideoFrame(name=_name(index), image=image, seconds=seconds)


def _name(index: int) -> str:
    return f"{index:06d}"


def check_format(path: str | Path) -> None:
    """Check, before any work is done, that a video can be written.

    Raises:
        OutputError: The suffix is not that of a format that can be written.
        InputError: PyAV is not installed.
    """
    if Path(path).suffix not in VIDEO_FORMATS:
        raise OutputError(f"{path}: videos are written as {', '.join(VIDEO_FORMATS)}")
    pyav()


@contextmanager
def write_video(
    path: str | Path, frames_per_second: float, *, overwrite: bool = False
) -> Iterator[Callable[[Image], None]]:
    """Write RGB images of one size as a video: yields a function to call with each image in turn.

    The film is H.264, in .webm VP8.

    Raises:
        OutputError: The suffix is not that of a format that can be written, or the file cannot be written.
        InputError: PyAV is not installed.
    """
    check_format(path)
    path = Path(path)
    with (
        replacing(path, overwrite=overwrite) as partial,
        pyav().open(str(partial), "w", format=VIDEO_FORMATS[path.suffix]) as container,
    ):
        stream = None
        codec, quality = _VP8 if path.suffix == ".webm" else _H264

        def write(image: Image) -> None:
            nonlocal stream
            even = np.pad(image, [(0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)], "edge")
            if stream is None:
                stream = container.add_stream(codec, Fraction(frames_per_second).limit_denominator(1001))
                stream.height, stream.width = even.shape[:2]
                stream.pix_fmt, stream.options = "yuv420p", dict(quality)
            frame = pyav().VideoFrame.from_ndarray(even, format="rgb24")
            container.mux(stream.encode(frame))

        yield write
        if stream is not None:
            container.mux(stream.encode(None))
