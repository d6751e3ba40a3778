"""Devices: cameras with their lenses and zooms, as EXIF names them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from PIL import ExifTags

_SMALLEST_FIELD_DEG, _LARGEST_FIELD_DEG = 5.0, 150.0  # of view, along the longer side
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_LONGEST_LENS_MM = 5000.0
_LARGEST_ZOOM = 100.0  # by software; more is a mistake
_LITTLE = 0.02  # relative difference of numbers that mean the same


@dataclass(frozen=True, kw_only=True)
class Device:
    """A camera with its lens and zoom, as EXIF names it. Photos of one device have the same intrinsics."""

    make: str = ""
    """Make of the camera; empty if unknown."""

    model: str = ""
    """Model of the camera; empty if unknown."""

    focal_mm: float = 0.0
    """Focal length of the lens in millimeters; 0 if unknown or impossible."""

    focal_35mm: float = 0.0
    """Focal length of the same field of view on film of 35 mm; 0 if unknown or impossible."""

    digital_zoom: float = 1.0
    """Factor of the digital zoom; 1 if there was none."""

    @property
    def is_known(self) -> bool:
        """Whether EXIF says anything."""
        return self != Device()

    def differs(self, other: "Device") -> bool:
        """Whether EXIF contradicts that two photos are of one device; what is unknown contradicts nothing."""
        return not (
            _agree(self.make, other.make)
            and _agree(self.model, other.model)
            and _agree(self.focal_mm, other.focal_mm)
            and _agree(self.focal_35mm, other.focal_35mm)
            and _agree(self.digital_zoom, other.digital_zoom)
        )

    def shares_focal_length(self, other: "Device") -> bool:
        """Whether both have a focal length of the same kind, which can be compared."""
        return min(self.focal_mm, other.focal_mm) > 0 or min(self.focal_35mm, other.focal_35mm) > 0

    def is_lens_of(self, other: "Device") -> bool:
        """Whether make, model and lens are known and the same, whatever was zoomed."""
        return (
            bool(self.model and other.model and self.focal_mm and other.focal_mm)
            and _agree(self.make, other.make)
            and self.model == other.model
            and _agree(self.focal_mm, other.focal_mm)
        )

    def zoom_over(self, other: "Device") -> float:
        """How much longer the focal length in pixels is than that of the same lens zoomed otherwise.

        Some devices include the digital zoom in the focal length for 35 mm: where that differs, it counts.
        """
        if self.focal_35mm and other.focal_35mm and not _agree(self.focal_35mm, other.focal_35mm):
            return self.focal_35mm / other.focal_35mm
        return self.digital_zoom / other.digital_zoom


def _agree(a: str | float, b: str | float) -> bool:
    if not (a and b):
        return True
    return a == b if isinstance(a, str) or isinstance(b, str) else abs(a / b - 1) < _LITTLE


def device_of(exif: Mapping[int, object], size: tuple[int, int]) -> Device:
    """The device that the EXIF data of a photo name.

    Args:
        exif: Values by tag.
        size: Width and height of the photo.
    """
    in_35mm = number(exif.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
    lens, zoom = number(exif.get(ExifTags.Base.FocalLength, 0)), exif.get(ExifTags.Base.DigitalZoomRatio, 0)
    return Device(
        make=_text(exif.get(ExifTags.Base.Make)),
        model=_text(exif.get(ExifTags.Base.Model)),
        focal_mm=round(lens, 1) if 0 < lens <= _LONGEST_LENS_MM else 0.0,
        focal_35mm=in_35mm if is_possible_focal(focal_of_film(in_35mm, size), max(size)) else 0.0,
        digital_zoom=(number(zoom) or 1.0) if is_zoom(zoom) else 1.0,
    )


def is_zoom(value: object) -> bool:
    """Whether a digital zoom is possible; 0 means that there was none."""
    ratio = number(value, math.nan)
    return ratio == 0 or 1 - _LITTLE <= ratio <= _LARGEST_ZOOM


def focal_of_film(in_35mm: float, size: tuple[int, int]) -> float:
    """Focal length in pixels for this width and height, from that for film of 35 mm."""
    return in_35mm / _FILM_DIAGONAL_MM * math.hypot(*size)


def is_possible_focal(focal_px: float, longer_side: int) -> bool:
    """Whether a lens may have this focal length."""
    if not (math.isfinite(focal_px) and focal_px > 0):
        return False
    field_deg = math.degrees(2 * math.atan2(longer_side, 2 * focal_px))
    return _SMALLEST_FIELD_DEG <= field_deg <= _LARGEST_FIELD_DEG


def number(value: object, otherwise: float = 0.0) -> float:
    """A finite number, or `otherwise`."""
    try:
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return otherwise
    return found if math.isfinite(found) else otherwise


def _text(value: object) -> str:
    return value.strip(" \0") if isinstance(value, str) else ""
