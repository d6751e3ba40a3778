"""Decode video files into the pictures that a player shows. Needs PyAV, which the extra `video` installs."""

from __future__ import annotations

from contextlib import suppress
from fractions import Fraction
from types import ModuleType
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Int32, UInt8

from slimsfm.arrays import Image
from slimsfm.errors import InputError, VideoError
from slimsfm.limits import check_pixels, current_limits

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator
    from pathlib import Path

    from av import VideoFrame as Decoded
    from av.container import InputContainer
    from av.video.stream import VideoStream

RGB = UInt8[np.ndarray, "_ _ 3"]
"""An image whose result may have another size."""

_MAX_PIXEL_ASPECT = 4  # width over height of a pixel, or its inverse; beyond, the file is wrong
_MAX_MISSING_S = 0.5  # by which a film may end before the time that its file states


def pyav() -> ModuleType:
    """The module `av`.

    Raises:
        InputError: PyAV is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise InputError("videos need PyAV: pip install 'slimsfm[video]'") from error
    return av


def open_film(path: Path) -> tuple[InputContainer, VideoStream]:
    """Open a video file and choose its film as ffmpeg does: the default, the longest, the largest.

    Raises:
        InputError: The file does not exist, cannot be read or has no film; a cover picture is none.
        ImageError: The film has more pixels than the limit.
    """
    av = pyav()
    options = {"max_pixels": str(round(1e6 * current_limits().max_megapixels))}  # also of later frames
    try:
        container = av.open(str(path), options=options)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such video") from error
    except (av.error.FFmpegError, OSError) as error:
        raise InputError(f"{path}: not a readable video") from error
    films = [
        one for one in container.streams.video if not one.disposition & av.stream.Disposition.attached_pic
    ]
    if not films:
        what = "no film, only a cover picture" if container.streams.video else "no images"
        container.close()
        raise InputError(f"{path}: contains {what}")
    best = container.streams.best("video")
    film = best if best in films else films[0]
    check_pixels(path, film.codec_context.width, film.codec_context.height)
    film.codec_context.options = options
    return container, film


def film_pictures(
    path: Path, container: InputContainer, stream: VideoStream
) -> Generator[tuple[Image, float | None]]:
    """Yield each picture with its time in seconds, None where the file has no times; then close the file.

    Pictures have square pixels and are rotated and mirrored as the file says.

    Raises:
        InputError: No picture can be decoded.
        VideoError: The film is damaged or cut off, or its size changes. All pictures before were yielded.
    """
    index, last, shape = -1, None, None
    with container:
        stream.thread_type = "AUTO"
        try:
            for index, last in enumerate(_decoded(container, stream)):
                image = _as_shown(last, stream)
                if image.shape != (shape := shape or image.shape):
                    raise VideoError(
                        f"{path}: ends before frame {index}, which has {_size(image.shape)} pixels; "
                        f"the frames before have {_size(shape)}"
                    )
                yield image, _seconds(last)
        except pyav().error.FFmpegError as error:
            if shape is not None:
                raise VideoError(f"{path}: is damaged and cannot be decoded beyond frame {index}") from error
        if last is None or shape is None:
            raise InputError(f"{path}: no frame can be decoded; the file is damaged")
        _check_end(path, index, last, _stated_end(container, stream))
        if container.format.name == "avi" and stream.frames > index + 1:  # it states frames, no times
            raise VideoError(f"{path}: is cut off after frame {index} of {stream.frames}")


def _decoded(container: InputContainer, stream: VideoStream) -> Iterator[Decoded]:
    """The frames; at an error first those that the decoder holds back, on however many threads it runs."""
    try:
        for packet in container.demux(stream):
            yield from packet.decode()
    except pyav().error.FFmpegError:
        with suppress(pyav().error.FFmpegError):
            yield from stream.codec_context.decode(None)
        raise


def _as_shown(frame: Decoded, stream: VideoStream) -> Image:
    aspect = stream.sample_aspect_ratio or stream.codec_context.sample_aspect_ratio
    image = with_square_pixels(frame.to_ndarray(format="rgb24"), aspect)
    try:
        matrix = frame.side_data.get("DISPLAYMATRIX")
    except ValueError:  # PyAV does not know all kinds of side data, for example of stereo films
        return np.ascontiguousarray(np.rot90(image, round(frame.rotation / 90)))
    return image if matrix is None else displayed(image, np.frombuffer(bytes(matrix), np.int32))


def with_square_pixels(image: RGB, aspect: Fraction | None) -> RGB:
    """Widen the axis along which pixels are longer until they are square.

    Args:
        image: RGB.
        aspect: Width of a pixel over its height; None, 0 and what is not within 1/4 to 4 is ignored.
    """
    if not aspect or not Fraction(1, _MAX_PIXEL_ASPECT) <= aspect <= _MAX_PIXEL_ASPECT:
        return image
    height, width = image.shape[:2]
    size = (round(width * max(aspect, 1)), round(height / min(aspect, 1)))
    if size == (width, height):
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def displayed(image: RGB, matrix: Int32[np.ndarray, " 9"]) -> RGB:
    """Rotate and mirror an image as a display matrix says, to the nearest of the eight ways.

    Args:
        image: RGB.
        matrix: The nine numbers of an ISO base media file: they map pixel (p, q), with q down, to
            (a p + c q, b p + d q), for a, b, c, d at positions 0, 1, 3, 4.
    """
    a, b, c, d = (int(matrix[i]) for i in (0, 1, 3, 4))
    turned = abs(b) + abs(c) > abs(a) + abs(d)
    right, down = (c, b) if turned else (a, d)
    image = image.swapaxes(0, 1) if turned else image
    return np.ascontiguousarray(image[:: -1 if down < 0 else 1, :: -1 if right < 0 else 1])


def _seconds(frame: Decoded) -> float | None:
    ticks = frame.dts if frame.pts is None else frame.pts
    return None if ticks is None or not frame.time_base else float(ticks * frame.time_base)


def _stated_end(container: InputContainer, stream: VideoStream) -> float | None:
    """Time in seconds at which the file says that the film ends; None where it does not."""
    start = float((stream.start_time or 0) * (stream.time_base or 0))
    if stream.duration and stream.time_base:
        return start + float(stream.duration * stream.time_base)
    with suppress(KeyError, ValueError):
        hours, minutes, seconds = stream.metadata["DURATION"].split(":")  # of Matroska
        return 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    alone = len(container.streams) == 1 and container.duration
    return start + container.duration / pyav().time_base if alone else None


def _check_end(path: Path, index: int, last: Decoded, stated: float | None) -> None:
    seconds = _seconds(last)
    end = seconds and seconds + float((last.duration or 0) * (last.time_base or 0))
    if stated and end and stated - end > _MAX_MISSING_S:
        raise VideoError(f"{path}: is cut off after frame {index}, at {end:.2f} s of {stated:.2f} s")
    if last.is_corrupt:
        raise VideoError(f"{path}: is cut off in frame {index}")


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
