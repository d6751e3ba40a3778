"""Images that clients send: what they are is checked by their first bytes, before a pixel is decoded."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from slimsfm.errors import ImageError
from slimsfm.photos import Orientation, Photo, opened_image, read_photo, reading
from slimsfm.serve.errors import ApiError
from slimsfm.skipping import reason_of

ImageFormat = Literal["JPEG", "PNG", "WebP"]

SMALLEST_SIDE, LARGEST_SIDE, MAX_PIXELS = 16, 8192, 16_000_000
"""Limits on the size of an image, in pixels."""

_MOST_SCANS = 64  # of a JPEG; progressive ones have about ten, and each costs the time of the whole image
_START_OF_SCAN = b"\xff\xda"
_PILLOW_NAMES = "JPEG", "MPO", "PNG", "WEBP"


def format_of(data: bytes) -> ImageFormat:
    """The format of an image file by its first bytes.

    Raises:
        ApiError: It is none of the three formats (415).
    """
    if data.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return "PNG"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WebP"
    raise ApiError(415, "not_an_image", "the body must be a JPEG, PNG or WebP file as it is")


@contextmanager
def image_file(data: bytes) -> Iterator[Path]:
    """An image as a file in memory within the context, after its header was checked.

    Raises:
        ApiError: It is not an image of a known format (415), damaged or too small (422) or too large (413).
    """
    if format_of(data) == "JPEG" and data.count(_START_OF_SCAN) > _MOST_SCANS:
        raise ApiError(422, "bad_image", f"the JPEG has more than {_MOST_SCANS} scans")
    with _file_in_memory(data) as path, _answering(path):
        with reading(path), opened_image(path, any_size=True) as file:
            if file.format not in _PILLOW_NAMES:
                raise ApiError(415, "not_an_image", "the body must be a JPEG, PNG or WebP file as it is")
            _check_size(*file.size)
        yield path


def read_upright_or_stored(path: Path, orientation: Orientation) -> Photo:
    """The image of `image_file`, as the library reads it."""
    return read_photo(path, orientation, warn=False)


def _check_size(width: int, height: int) -> None:
    if min(width, height) < SMALLEST_SIDE:
        raise ApiError(
            422, "image_too_small", f"the image is {width}x{height}; sides need {SMALLEST_SIDE} pixels"
        )
    if max(width, height) > LARGEST_SIDE or width * height > MAX_PIXELS:
        raise ApiError(
            413,
            "image_too_large",
            f"the image is {width}x{height}; sides may have {LARGEST_SIDE} pixels, the image "
            f"{MAX_PIXELS // 10**6} megapixels; shrink it",
        )


@contextmanager
def _answering(path: Path) -> Iterator[None]:
    """Turn what is wrong with an image into an answer."""
    try:
        yield
    except ImageError as error:
        raise ApiError(422, "bad_image", reason_of(error, path)) from error


@contextmanager
def _file_in_memory(data: bytes) -> Iterator[Path]:
    """A file that readers can open by its path and that no disk holds, where the system has such."""
    if hasattr(os, "memfd_create"):
        with os.fdopen(os.memfd_create("image"), "wb", buffering=0) as file:
            file.write(data)
            yield Path(f"/proc/self/fd/{file.fileno()}")
        return
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        yield Path(file.name)
