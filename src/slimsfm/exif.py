"""What the EXIF data of a photo say about its camera: a first guess, never a fact.

Editors, messengers and broken cameras write focal lengths that no lens has. A focal length is used only if it
gives a possible field of view. A crop or a digital zoom makes it wrong: see `Exif.doubt`.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pycolmap
from PIL import ExifTags
from PIL import Image as PillowImage

from slimsfm.devices import Device, device_of, focal_of_film, is_possible_focal, is_zoom, number
from slimsfm.image_files import named
from slimsfm.photos import Orientation, exif_of, exif_orientation, opened_image, reading

_GUESS = 1.2  # focal length over the longer side, as in COLMAP
_SIDEWAYS = 5  # EXIF orientations from here on swap width and height
_LITTLE = 0.02  # relative difference of shapes that are the same
_SLIGHT_ZOOM = 1.15  # a focal length that is off by less is still approximate
_SLIGHT_CROP = 0.7  # share of the longer or shorter side that is left, from which on the same holds
_HAS_CROP = re.compile(rb"""crs:HasCrop\s*(?:=\s*["']|>)\s*true""", re.IGNORECASE)  # in XMP, by Adobe


@dataclass(frozen=True, kw_only=True)
class Exif:
    """EXIF data of a photo, as far as they concern its camera."""

    stored_size: tuple[int, int]
    """Width and height of the pixels as they are stored."""

    orientation: int
    """EXIF orientation, from 1 to 8."""

    focal_px: float | None
    """Focal length in pixels of the whole photo without digital zoom; None if it is unknown or impossible."""

    ignored: str
    """The values that were ignored because they are impossible; empty if none was."""

    device: Device
    """The camera with its lens."""

    original_size: tuple[int, int] | None = None
    """Width and height when the photo was taken, as EXIF says."""

    has_crop: bool = False
    """Whether an editor says that it cropped the photo."""

    @property
    def problem(self) -> str:
        """Why the focal length is unknown, where it is."""
        if self.doubt:
            return self.doubt
        return f"EXIF has {self.ignored}, which is impossible" if self.ignored else "no EXIF data"

    @property
    def is_crop(self) -> bool:
        """Whether the photo is a part of what the camera saw."""
        return self.has_crop or self._sides_left is not None

    @property
    def doubt(self) -> str:
        """Why the focal length is not even approximate although EXIF has one; empty if it is."""
        left, zoom = self._sides_left, self.device.digital_zoom
        if self.has_crop:
            return "the photo was cropped (crs:HasCrop)"
        if left is not None and not _SLIGHT_CROP <= max(left) <= 1 + _LITTLE:
            (width, height), (before, above) = self.stored_size, self.original_size or (0, 0)
            return f"its {width}x{height} pixels were cut out of {before}x{above}"
        if self.device.focal_35mm and zoom > _SLIGHT_ZOOM:
            return f"whether it includes the digital zoom ({zoom:g}x) is unknown"
        return ""

    @property
    def approximate_focal_px(self) -> float | None:
        """Focal length in pixels, also of a photo that was cropped or zoomed; None if it is unknown."""
        if self.focal_px is None or self.doubt:
            return None
        focal, left = self.focal_px, self._sides_left
        if not self.device.focal_35mm:
            focal *= self.device.digital_zoom
        if left is not None and self.original_size is not None:
            measure = math.hypot if self.device.focal_35mm else lambda *size: max(size)
            focal *= measure(*self.original_size) / measure(*self.stored_size) * math.sqrt(max(left))
        return focal

    @property
    def _sides_left(self) -> tuple[float, float] | None:
        """How much of the shorter and longer side is left of a photo that changed its shape."""
        if self.original_size is None:
            return None
        (short, long), (whole_short, whole_long) = sorted(self.stored_size), sorted(self.original_size)
        left = short / whole_short, long / whole_long
        return left if abs(left[0] / left[1] - 1) > _LITTLE else None

    def size(self, orientation: Orientation) -> tuple[int, int]:
        """Width and height of the pixels."""
        width, height = self.stored_size
        turned = orientation == "upright" and self.orientation >= _SIDEWAYS
        return (height, width) if turned else (width, height)

    def camera(self, orientation: Orientation) -> pycolmap.Camera:
        """A SIMPLE_RADIAL camera without distortion, with the focal length or else 1.2 times the longer side.

        `has_prior_focal_length` says whether the focal length is from EXIF.
        """
        focal = self.focal_px or _GUESS * max(self.stored_size)
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, *self.size(orientation))
        camera.has_prior_focal_length = self.focal_px is not None
        return camera


def read_exif(path: str | Path) -> Exif:
    """Read the EXIF data of an image.

    Raises:
        ImageError: The file is missing or not an image.
    """
    with reading(path), opened_image(path) as file:
        exif, size, tag = exif_of(file), stored_size(file), exif_orientation(file)
        has_crop = _HAS_CROP.search(_xmp(file)) is not None
    found = {name: exif[key] for name, key in _FOCAL_LENGTHS.items() if key in exif}
    in_35mm = number(found.get("FocalLengthIn35mmFilm", 0))
    focal = _inferred_focal(path) if exif else None  # COLMAP decodes the image to find that it has no EXIF
    if focal is None and in_35mm > 0:  # a format that COLMAP does not read
        focal = focal_of_film(in_35mm, size)
    is_possible = focal is not None and is_possible_focal(focal, max(size))
    is_wrong = focal is not None or number(found.get("FocalLengthIn35mmFilm", 1)) <= 0
    ignored = [f"{name} {found[name]}" for name in found] if is_wrong and not is_possible else []
    zoom = exif.get(ExifTags.Base.DigitalZoomRatio, 0)
    if not is_zoom(zoom):
        ignored.append(f"DigitalZoomRatio {zoom}")
    return Exif(
        stored_size=size,
        orientation=tag,
        focal_px=focal if is_possible else None,
        ignored=", ".join(ignored),
        device=device_of(exif, size),
        original_size=_original_size(exif),
        has_crop=has_crop,
    )


def read_device(path: str | Path) -> Device:
    """Read which device a photo was taken with.

    Raises:
        ImageError: The file is missing or not an image.
    """
    with reading(path), opened_image(path) as file:
        return device_of(exif_of(file), stored_size(file))


def _original_size(exif: Mapping[int, object]) -> tuple[int, int] | None:
    width, height = (
        int(number(exif.get(tag, 0))) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)
    )
    return (width, height) if min(width, height) > 0 else None


def _xmp(file: PillowImage.Image) -> bytes:
    """The XMP data of an open image file, as they are."""
    found = file.info.get("xmp") or file.info.get("XML:com.adobe.xmp") or b""
    return found.encode() if isinstance(found, str) else bytes(found)


_FOCAL_LENGTHS = {
    "FocalLengthIn35mmFilm": ExifTags.Base.FocalLengthIn35mmFilm,
    "FocalLength": ExifTags.Base.FocalLength,
    "FocalPlaneXResolution": ExifTags.Base.FocalPlaneXResolution,
}


def _inferred_focal(path: str | Path) -> float | None:
    """The focal length in pixels as COLMAP infers it, also from its database of sensor sizes."""
    try:
        camera = pycolmap.infer_camera_from_image(path)
    except (RuntimeError, ValueError):
        return None  # a format that COLMAP does not read
    return camera.mean_focal_length() if camera.has_prior_focal_length else None


def camera_from_exif(path: str | Path, orientation: Orientation = "upright") -> pycolmap.Camera:
    """Guess the camera of an image; see `Exif.camera`.

    Raises:
        ImageError: The file is missing or not an image.
    """
    return read_exif(path).camera(orientation)


def read_orientation(path: str | Path) -> int:
    """The EXIF orientation of an image file, from 1 to 8.

    Raises:
        ImageError: The file is missing or not an image.
    """
    with reading(path), opened_image(path) as file:
        return exif_orientation(file)


def stored_size(file: PillowImage.Image) -> tuple[int, int]:
    """Width and height of the pixels of an open image file as they are stored.

    Pillow gives the upright size of TIFF files.
    """
    tags = getattr(file, "tag_v2", {})
    if ExifTags.Base.ImageWidth in tags and ExifTags.Base.ImageLength in tags:
        return tags[ExifTags.Base.ImageWidth], tags[ExifTags.Base.ImageLength]
    return file.size


def ignored_values(exifs: Mapping[str, Exif]) -> tuple[str, ...]:
    """A sentence for each impossible value, with the names of its photos."""
    names: dict[str, list[str]] = {}
    for name, exif in exifs.items():
        if exif.ignored:
            names.setdefault(exif.ignored, []).append(name)
    return tuple(
        named(f"photo(s) whose EXIF focal length or zoom is impossible and ignored ({ignored})", some)
        for ignored, some in names.items()
    )
