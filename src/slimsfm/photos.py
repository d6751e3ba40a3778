"""Image files: list them, read their upright pixels, and guess their cameras from EXIF data."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import UInt8
from PIL import ExifTags, ImageOps, UnidentifiedImageError
from PIL import Image as PillowImage

from slimsfm.arrays import GrayImage, Image
from slimsfm.errors import ImageError, InputError

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})

_UNREADABLE = (
    UnidentifiedImageError,
    PillowImage.DecompressionBombError,
    OSError,
    ValueError,
    SyntaxError,
    RuntimeError,
)


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


def read_image(path: str | Path) -> Image:
    """Read an image as RGB and rotate it upright according to its EXIF orientation.

    Raises:
        ImageError: The file is missing or not a complete image.
    """
    with _reading(path), PillowImage.open(path) as file:
        upright = ImageOps.exif_transpose(file)
        if upright.mode.startswith("I;16"):  # Pillow would clip 16 bits to 8 instead of scaling them
            upright = PillowImage.fromarray((np.asarray(upright) >> 8).astype(np.uint8))
        return np.array(upright.convert("RGB"))


@contextmanager
def _reading(path: str | Path) -> Iterator[None]:
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


def camera_from_exif(path: str | Path) -> pycolmap.Camera:
    """Guess the camera of an image: focal length from EXIF, or else 1.2 times the longer side.

    Returns:
        A SIMPLE_RADIAL camera of the upright image without distortion; `has_prior_focal_length` says
        whether the focal length is from EXIF.

    Raises:
        ImageError: The file is missing or not an image.
    """
    with _reading(path), PillowImage.open(path) as file:
        turned = file.getexif().get(ExifTags.Base.Orientation, 1) >= 5
        upright_size = file.size[::-1] if turned else file.size
        camera = pycolmap.infer_camera_from_image(path)
    guess = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", camera.focal_length, *upright_size)
    guess.has_prior_focal_length = camera.has_prior_focal_length
    return guess


def shrink(image: UInt8[np.ndarray, "_ _ *channels"], max_size: int) -> UInt8[np.ndarray, "_ _ *channels"]:
    """Shrink an RGB or gray image so that its longer side has at most `max_size` pixels."""
    height, width = image.shape[:2]
    scale = min(1.0, max_size / max(height, width))
    if scale == 1.0:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
