"""Image files: read their pixels, upright or as they are stored.

Pixels of more than eight bits are scaled to eight by the bits that the image uses: 8, 10, 12, 14, 16 ... hold
its largest value. So 12-bit values in a file of 16 bits are as bright as in one of 12. Floating-point values
are from 0 (black) to 1 (white) unless one is larger, and then count as integers; values below 0 and those
that are no number are black.
"""

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from io import BufferedReader, BytesIO
from pathlib import Path
from threading import Lock
from typing import Any, Literal, NamedTuple, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Shaped, UInt8
from PIL import ExifTags, ImageCms, UnidentifiedImageError
from PIL import Image as PillowImage

from slimsfm.arrays import GrayImage, Image
from slimsfm.errors import ImageError
from slimsfm.image_files import INSTALL_HEIC, can_read_heic
from slimsfm.limits import check_pixels

Orientation = Literal["upright", "stored"]
"""Which pixels of an image file: turned upright according to its EXIF orientation, or as they are stored, as
COLMAP and hloc read them."""

_LOGGER = logging.getLogger(__name__)
_UNREADABLE = (UnidentifiedImageError, OSError, EOFError, ValueError, SyntaxError, RuntimeError)
_HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
_WIDE = "I", "F"  # first letters of Pillow's modes of more than eight bits
_STRIP = (
    256  # rows that are converted at a time, because a large image exists once or twice but not more often
)
_SMALL = 4_000_000  # pixels of an image that may exist once more, because that is faster
_PILLOW_LIMIT = Lock()


@dataclass(frozen=True, kw_only=True, eq=False)
class Photo:
    """An image, upright or as it is stored, and what its file says besides."""

    image: Image
    """RGB."""

    alpha: GrayImage | None
    """0 where the image is fully transparent, 255 elsewhere; None if it is nowhere."""

    orientation: int
    """EXIF orientation of the file, from 1 to 8; 1 if it has none."""

    num_frames: int
    """Number of frames or pages in the file, of which this is the first."""

    @property
    def visible(self) -> GrayImage | None:
        """The mask of a query: `alpha`, unless nothing would be left."""
        return self.alpha if self.alpha is not None and self.alpha.any() else None


def read_photo(path: str | Path, orientation: Orientation = "upright", *, warn: bool = True) -> Photo:
    """Read an image of any format, color mode and bit depth.

    Args:
        path: The file; of several frames or pages the first is read.
        orientation: Whether to turn the pixels upright by the EXIF orientation of the file.
        warn: Log a warning if there are several.

    Raises:
        ImageError: The file is missing, not a complete image, or too large.
        ValueError: `orientation` is not a value of `Orientation`.
    """
    if orientation not in get_args(Orientation):
        raise ValueError(
            f"orientation must be one of {', '.join(get_args(Orientation))}, got {orientation!r}"
        )
    stored = _read(path)
    if warn and stored.num_frames > 1:
        _LOGGER.warning("%s: the first of %d frames or pages is used", path, stored.num_frames)
    image, alpha = _as_rgb(stored.values), stored.alpha
    if orientation == "upright":
        image = upright(image, stored.orientation)
        alpha = None if alpha is None else upright(alpha, stored.orientation)
    return Photo(image=image, alpha=alpha, orientation=stored.orientation, num_frames=stored.num_frames)


def read_image(path: str | Path, orientation: Orientation = "upright") -> Image:
    """Read an image as RGB like `read_photo`, without its transparency.

    Raises:
        ImageError: As in `read_photo`.
    """
    return read_photo(path, orientation).image


class StoredMask(NamedTuple):
    """A mask as its file holds it."""

    mask: GrayImage
    """255 where features are kept, 0 elsewhere."""

    orientation: int
    """EXIF orientation of the file, 1 if it has none."""


def read_stored_mask(path: str | Path) -> StoredMask:
    """Read a mask of any color mode and bit depth as stored: what is not black or transparent is kept.

    Raises:
        ImageError: As in `read_photo`.
    """
    stored = _read(path)
    kept = np.asarray(stored.values.reshape(*stored.values.shape[:2], -1).any(axis=2))
    if stored.alpha is not None:
        kept &= stored.alpha > 0
    return StoredMask(mask=_white_where(kept), orientation=stored.orientation)


def _white_where(kept: Bool[np.ndarray, "h w"]) -> GrayImage:
    return np.where(kept, np.uint8(255), np.uint8(0))


def read_mask(path: str | Path) -> GrayImage:
    """Read a mask like `read_stored_mask`, turned upright by its EXIF orientation.

    Raises:
        ImageError: As in `read_photo`.
    """
    return upright(*read_stored_mask(path))


def upright(
    stored: Shaped[np.ndarray, "_ _ *channels"], orientation: int
) -> Shaped[np.ndarray, "_ _ *channels"]:
    """Turn stored pixels upright that have this EXIF orientation."""
    if orientation >= 5:
        stored = stored.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        stored = stored[::-1]
    if orientation in (2, 3, 6, 7):
        stored = stored[:, ::-1]
    return np.ascontiguousarray(stored)


def as_stored(
    upright: Shaped[np.ndarray, "_ _ *channels"], orientation: int
) -> Shaped[np.ndarray, "_ _ *channels"]:
    """Turn upright pixels as a file of this EXIF orientation stores them."""
    if orientation in (2, 3, 6, 7):
        upright = upright[:, ::-1]
    if orientation in (3, 4, 7, 8):
        upright = upright[::-1]
    if orientation >= 5:
        upright = upright.swapaxes(0, 1)
    return np.ascontiguousarray(upright)


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


class _Stored(NamedTuple):
    values: Shaped[np.ndarray, "_ _ *channels"]  # gray or RGB of any depth
    alpha: GrayImage | None
    orientation: int
    num_frames: int


def _read(path: str | Path) -> _Stored:
    with reading(path), opened_image(path) as file:
        is_deep = _is_deep(file)  # first, because Pillow forgets the depth when it decodes
        orientation = exif_orientation(file)
        values, alpha = (_deep_values(path) if is_deep else None) or (None, None)
        # The other pictures of an MPO, which many phones call JPEG, are previews and gain maps.
        num_frames = 1 if file.format == "MPO" else getattr(file, "n_frames", 1)
        if values is None:
            values, alpha = _values(file)
            if exif_orientation(file) != orientation:  # Pillow turns TIFF files when it decodes them
                values = as_stored(values, orientation)
                alpha = None if alpha is None else as_stored(alpha, orientation)
        if alpha is not None:
            alpha = None if alpha.all() else _white_where(alpha > 0)
        return _Stored(values, alpha, orientation, num_frames)


def _values(
    file: PillowImage.Image,
) -> tuple[Shaped[np.ndarray, "_ _ *channels"], Shaped[np.ndarray, "_ _"] | None]:
    """Gray or RGB values and alpha as Pillow decodes them."""
    if file.mode.startswith(_WIDE):
        return np.array(file), None
    file.load()
    if not file.has_transparency_data:
        return _converted(file, "RGB"), None
    pixels = _converted(file, "RGBA")
    return pixels[..., :3], pixels[..., 3]


def _converted(file: PillowImage.Image, mode: Literal["RGB", "RGBA"]) -> UInt8[np.ndarray, "_ _ channels"]:
    if file.mode == mode and file.height * file.width <= _SMALL:
        return np.array(file)
    found = np.empty((file.height, file.width, len(mode)), np.uint8)
    for top in range(0, file.height, _STRIP):
        strip = file.crop((0, top, file.width, min(file.height, top + _STRIP)))
        if strip.mode == "LAB":
            lab, rgb = (ImageCms.createProfile(space) for space in ("LAB", "sRGB"))
            strip = ImageCms.profileToProfile(strip, lab, rgb, outputMode="RGB") or strip
        found[top : top + _STRIP] = np.asarray(strip.convert(mode))
    return found


def _deep_values(
    path: str | Path,
) -> tuple[Shaped[np.ndarray, "_ _ _"], Shaped[np.ndarray, "_ _"] | None] | None:
    """RGB of 16 bits per channel, of which Pillow keeps the upper eight, and alpha; None for other images."""
    _check_whole(path)
    found = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if found is None or found.dtype != np.uint16 or found.ndim != 3:
        return None
    return found[..., 2::-1], found[..., 3] if found.shape[2] == 4 else None


def _check_whole(path: str | Path) -> None:
    """Decode an image by Pillow and forget it: OpenCV takes half a file for a whole one, Pillow does not."""
    with opened_image(path) as file:
        file.load()


def _is_deep(file: PillowImage.Image) -> bool:
    if file.mode.startswith(_WIDE):
        return False
    arguments = [tile[3] for tile in getattr(file, "tile", [])]
    parts = [part for one in arguments for part in (one if isinstance(one, tuple) else (one,))]
    if file.format == "PPM":
        return any(isinstance(part, int) and part > 255 for part in parts)
    return any(isinstance(part, str) and ";16" in part for part in parts)


def _as_rgb(values: Shaped[np.ndarray, "h w *channels"]) -> UInt8[np.ndarray, "h w 3"]:
    if values.dtype != np.uint8:
        values = _as_bytes(values)
    return np.repeat(values[..., None], 3, axis=2) if values.ndim == 2 else values


def _as_bytes(values: Shaped[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Scale values of more than eight bits to eight, by the rule at the top of this module."""
    strips = [slice(top, top + _STRIP) for top in range(0, len(values), _STRIP)]
    is_float = np.issubdtype(values.dtype, np.floating)
    most = max((_not_negative(values[strip]).max(initial=0) for strip in strips), default=0)
    bits = 0 if is_float and most <= 1 else max(8, int(most).bit_length())
    found = np.empty(values.shape, np.uint8)
    for strip in strips:
        kept = _not_negative(values[strip])
        found[strip] = kept // 2 ** (bits + bits % 2 - 8) if bits else np.round(255 * kept)
    return found


def _not_negative(values: Shaped[np.ndarray, "*shape"]) -> Shaped[np.ndarray, "*shape"]:
    if np.issubdtype(values.dtype, np.floating):
        values = np.where(np.isfinite(values), values, 0)
    return np.maximum(values, 0)


@contextmanager
def opened_image(path: str | Path, *, any_size: bool = False) -> Iterator[PillowImage.Image]:
    """Open an image file by Pillow, HEIC included; of any size only to look at its header.

    Raises:
        ImageError: It is a HEIC photo, and the package for them is missing, or it has more pixels than the
            limit.
    """
    with Path(path).open("rb") as raw:  # given a path, Pillow maps TIFF into memory and mixes up turned ones
        head = raw.read(12)
        if head[4:8] == b"ftyp" and head[8:] in _HEIC_BRANDS and not _register_heic() and head[8:] != b"mif1":
            raise ImageError(f"{path}: {INSTALL_HEIC}")
        with _open(raw) as file:
            if not any_size:
                check_pixels(path, *file.size)
            yield file


def decode_jpeg(data: UInt8[np.ndarray, " bytes"], source: str) -> Image:
    """Decode a JPEG file in memory.

    Raises:
        ImageError: It is damaged, or has more pixels than the limit; the message names the source.
    """
    with reading(source), _open(BytesIO(data.tobytes())) as file:
        check_pixels(source, *file.size)
        photo = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if file.format == "JPEG" else None
        if photo is None:
            raise ValueError("not a JPEG file")
    return np.asarray(photo, np.uint8)


def _open(raw: BufferedReader | BytesIO) -> PillowImage.Image:
    """Open an image of any size. Pillow's own limit, a global, warns of images that ours allows."""
    with _PILLOW_LIMIT:
        limit, PillowImage.MAX_IMAGE_PIXELS = PillowImage.MAX_IMAGE_PIXELS, None
        try:
            return PillowImage.open(raw)
        finally:
            PillowImage.MAX_IMAGE_PIXELS = limit


@cache
def _register_heic() -> bool:
    """Teach Pillow to read HEIC; returns whether that is possible."""
    if not can_read_heic():
        return False
    import pillow_heif  # an extra

    pillow_heif.register_heif_opener()
    return True


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Report a file that cannot be read as an image as an `ImageError` that says what to do."""
    try:
        yield
    except FileNotFoundError as error:
        raise ImageError(f"{path}: no such image") from error
    except PermissionError as error:
        raise ImageError(f"{path}: may not be read; change its permissions or remove it") from error
    except _UNREADABLE as error:
        raise ImageError(
            f"{path}: not a readable image: damaged, or of a kind that is not supported; convert, replace or "
            "remove it"
        ) from error


def shrink(image: UInt8[np.ndarray, "_ _ *channels"], max_size: int) -> UInt8[np.ndarray, "_ _ *channels"]:
    """Shrink an RGB or gray image so that its longer side has at most `max_size` pixels."""
    height, width = image.shape[:2]
    scale = min(1.0, max_size / max(height, width))
    if scale == 1.0:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
