"""What the EXIF data of a photo say about its camera: a first guess, never a fact.

Editors, messengers and broken cameras write focal lengths that no lens has. A focal length is used only if it
gives a possible field of view.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pycolmap
from PIL import ExifTags
from PIL import Image as PillowImage

from slimsfm.image_files import named
from slimsfm.photos import Orientation, exif_of, exif_orientation, opened_image, reading

_SMALLEST_FIELD_DEG, _LARGEST_FIELD_DEG = 5.0, 150.0  # of view, along the longer side
_GUESS = 1.2  # focal length over the longer side, as in COLMAP
_SIDEWAYS = 5  # EXIF orientations from here on swap width and height


@dataclass(frozen=True, kw_only=True)
class Exif:
    """EXIF data of a photo, as far as they concern its camera."""

    stored_size: tuple[int, int]
    """Width and height of the pixels as they are stored."""

    orientation: int
    """EXIF orientation, from 1 to 8."""

    focal_px: float | None
    """Focal length in pixels; None if it is unknown or impossible."""

    ignored: str
    """The focal lengths that were ignored because they are impossible; empty if none was."""

    device: tuple[str, str, float]
    """Make and model of the camera and focal length of the lens in millimeters; empty or 0 if unknown."""

    @property
    def problem(self) -> str:
        """Why the focal length is unknown."""
        return f"EXIF has {self.ignored}, which is impossible" if self.ignored else "no EXIF data"

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
    found = {name: exif[key] for name, key in _FOCAL_LENGTHS.items() if key in exif}
    focal = _inferred_focal(path)
    is_possible = focal is not None and _is_possible(focal, max(size))
    is_wrong = focal is not None or _number(found.get("FocalLengthIn35mmFilm", 1)) <= 0
    return Exif(
        stored_size=size,
        orientation=tag,
        focal_px=focal if is_possible else None,
        ignored=", ".join(f"{name} {found[name]}" for name in found) if is_wrong and not is_possible else "",
        device=(
            _text(exif.get(ExifTags.Base.Make)),
            _text(exif.get(ExifTags.Base.Model)),
            round(_number(found.get("FocalLength", 0)), 1),
        ),
    )


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


def _is_possible(focal_px: float, longer_side: int) -> bool:
    if not (math.isfinite(focal_px) and focal_px > 0):
        return False
    field_deg = math.degrees(2 * math.atan2(longer_side, 2 * focal_px))
    return _SMALLEST_FIELD_DEG <= field_deg <= _LARGEST_FIELD_DEG


def _number(value: object) -> float:
    """A finite number; 0 for anything else."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) else 0.0


def _text(value: object) -> str:
    return value.strip(" \0") if isinstance(value, str) else ""


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
    """A sentence for each impossible focal length, with the names of its photos."""
    names: dict[str, list[str]] = {}
    for name, exif in exifs.items():
        if exif.ignored:
            names.setdefault(exif.ignored, []).append(name)
    return tuple(
        named(f"photo(s) whose EXIF focal length is impossible and ignored ({ignored})", some)
        for ignored, some in names.items()
    )
