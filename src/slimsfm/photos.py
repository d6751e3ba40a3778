"""Image files: list them, and read their pixels, upright or as they are stored."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, UnidentifiedImageError
from PIL import Image as PillowImage

from slimsfm.arrays import GrayImage, Image
from slimsfm.errors import ImageError, InputError

Orientation = Literal["upright", "stored"]
"""Which pixels of an image file: turned upright according to its EXIF orientation, or as they are stored, as
COLMAP and hloc read them."""

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})

_UNREADABLE = (
    UnidentifiedImageError,
    PillowImage.DecompressionBombError,
    OSError,
    ValueError,
    SyntaxError,
    RuntimeError,
)

_TURN = PillowImage.Transpose
_UPRIGHT = {
    2: _TURN.FLIP_LEFT_RIGHT,
    3: _TURN.ROTATE_180,
    4: _TURN.FLIP_TOP_BOTTOM,
    5: _TURN.TRANSPOSE,
    6: _TURN.ROTATE_270,
    7: _TURN.TRANSVERSE,
    8: _TURN.ROTATE_90,
}  # from the stored pixels, by EXIF orientation
_STORED = _UPRIGHT | {6: _TURN.ROTATE_90, 8: _TURN.ROTATE_270}  # from the upright pixels


def list_images(folder: str | Path) -> list[str]:
    """List the images in a folder and its subfolders.

    Returns:
        Paths relative to the folder, with forward slashes, sorted; without hidden files and folders.

    Raises:
        InputError: The folder does not exist or contains no image.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of images")
    paths = (path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    names = sorted(path.relative_to(folder).as_posix() for path in paths)
    names = [name for name in names if not any(part.startswith(".") for part in name.split("/"))]
    if not names:
        raise InputError(f"{folder}: contains no image ({', '.join(sorted(SUFFIXES))})")
    return names


def read_image(path: str | Path, orientation: Orientation = "upright") -> Image:
    """Read an image as RGB.

    Args:
        path: The file.
        orientation: Whether to turn the pixels upright according to the EXIF orientation of the file.

    Raises:
        ImageError: The file is missing or not a complete image.
    """
    with reading(path), PillowImage.open(path) as file:
        tag = exif_orientation(file)
        file.load()
        is_upright = exif_orientation(file) != tag  # Pillow turns TIFF files itself
        turns = {} if is_upright == (orientation == "upright") else _STORED if is_upright else _UPRIGHT
        picture = file.transpose(turns[tag]) if tag in turns else file
        if picture.mode.startswith("I;16"):  # Pillow would clip 16 bits to 8 instead of scaling them
            picture = PillowImage.fromarray((np.asarray(picture) >> 8).astype(np.uint8))
        return np.array(picture.convert("RGB"))


def exif_orientation(file: PillowImage.Image) -> int:
    """The EXIF orientation of an open image file, from 1 to 8; 1, which is upright, if it has none."""
    tag = exif_of(file).get(ExifTags.Base.Orientation, 1)
    return tag if isinstance(tag, int) and 1 <= tag <= 8 else 1


def exif_of(file: PillowImage.Image) -> dict[int, Any]:
    """The EXIF data of an open image file by tag, with those of the lens; empty if they are damaged."""
    try:
        exif = file.getexif()
        return {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
    except (SyntaxError, ValueError, KeyError, TypeError, struct.error):
        return {}


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Report a file that Pillow cannot read as an `ImageError`."""
    try:
        yield
    except FileNotFoundError as error:
        raise ImageError(f"{path}: no such image") from error
    except _UNREADABLE as error:
        raise ImageError(f"{path}: not a readable image; remove or replace it") from error


def read_mask(path: str | Path) -> GrayImage:
    """Read a mask of any color mode: features are kept where it is not black.

    Raises:
        ImageError: The file is missing or not a complete image.
    """
    return read_image(path).max(axis=2)


def shrink(image: UInt8[np.ndarray, "_ _ *channels"], max_size: int) -> UInt8[np.ndarray, "_ _ *channels"]:
    """Shrink an RGB or gray image so that its longer side has at most `max_size` pixels."""
    height, width = image.shape[:2]
    scale = min(1.0, max_size / max(height, width))
    if scale == 1.0:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
