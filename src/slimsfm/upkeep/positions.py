"""Known positions of images: from a table, or from the GPS that EXIF holds."""

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from io import StringIO
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from PIL import ExifTags

from slimsfm.devices import number
from slimsfm.errors import ImageError, InputError
from slimsfm.files import contents_of, inside, read_text
from slimsfm.image_files import named
from slimsfm.photos import opened_image, reading

Position = Float64[np.ndarray, "3"]

_METRIC, _GEOGRAPHIC = ("x", "y", "z"), ("latitude", "longitude", "height")
_BELOW_SEA = (1, 3)  # values of GPSAltitudeRef
_TAGS = ExifTags.GPS


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownPositions:
    """Positions of cameras by name of the image."""

    by_name: Mapping[str, Position]
    """In meters, or latitude and longitude in degrees and height in meters."""

    is_geographic: bool = False
    """Whether they are latitude, longitude and height (WGS84)."""

    source: str = "known positions"
    """What they are, in the plural."""

    notes: tuple[str, ...] = ()
    """Sentences, with names, on images whose position could not be read."""

    def __post_init__(self) -> None:
        for name, position in self.by_name.items():
            if not np.all(np.isfinite(position)) or (self.is_geographic and not _is_on_earth(position)):
                raise ValueError(f"by_name must hold positions, got {list(position)} for {name!r}")


def _is_on_earth(position: Position) -> bool:
    return bool(abs(position[0]) <= 90 and abs(position[1]) <= 180)


def read_positions(path: str | Path) -> KnownPositions:
    """Read positions of images from a table in CSV.

    Its header is `name,x,y,z`, in meters, or `name,latitude,longitude,height`, in degrees and meters; further
    columns are ignored. Names are those of the map.

    Raises:
        InputError: The file is missing, has other columns, no row, a name twice, or a value that is none.
    """
    path = Path(path)
    with contents_of(path, "not a readable table of positions"):
        rows = csv.DictReader(StringIO(read_text(path), newline=""))
        found = [one for one in (_METRIC, _GEOGRAPHIC) if {"name", *one} <= set(rows.fieldnames or ())]
        if not found:
            raise InputError(
                f"{path}: must have the columns name, x, y, z in meters, or name, latitude, longitude, height"
            )
        positions: dict[str, Position] = {}
        for line, row in enumerate(rows, start=2):
            name = row["name"]
            if name in positions:
                raise InputError(f"{path}: line {line}: {name!r} is there twice; remove one")
            positions[name] = _position(row, found[0], f"{path}: line {line}")
    if not positions:
        raise InputError(f"{path}: holds no position")
    return KnownPositions(by_name=positions, is_geographic=found[0] is _GEOGRAPHIC)


def _position(row: Mapping[str, str], columns: tuple[str, ...], place: str) -> Position:
    try:
        position = np.array([float(row[name]) for name in columns])
    except (TypeError, ValueError) as error:
        raise InputError(f"{place}: {', '.join(columns)} must be numbers") from error
    if not np.all(np.isfinite(position)) or (columns is _GEOGRAPHIC and not _is_on_earth(position)):
        raise InputError(f"{place}: {', '.join(columns)} are impossible")
    return position


def read_gps(folder: str | Path, names: Iterable[str]) -> KnownPositions:
    """Read the GPS positions in the EXIF data of photos.

    Photos without a position, with an impossible one, with 0° N 0° E, or without altitude are left out and
    counted.

    Args:
        folder: Folder of the photos.
        names: Their names in the map.

    Raises:
        InputError: No photo is there, or none has a position.
    """
    folder, positions, left_out = Path(folder), {}, dict[str, list[str]]()
    for name in names:
        found = _gps_of(inside(folder, name))
        if isinstance(found, str):
            left_out.setdefault(found, []).append(name)
        else:
            positions[name] = found
    notes = tuple(named(f"photo(s) {why}", some) for why, some in sorted(left_out.items()))
    if not positions:
        counts = ", ".join(f"{len(some)} {why}" for why, some in sorted(left_out.items()))
        count = sum(len(some) for some in left_out.values())
        raise InputError(
            f"{folder}: none of the map's {count} photos has a GPS position with altitude in EXIF "
            f"({counts}); give positions as CSV"
        )
    return KnownPositions(by_name=positions, is_geographic=True, source="GPS positions", notes=notes)


def _gps_of(path: Path) -> Position | str:
    """Latitude, longitude and altitude of a photo, or why it has none."""
    if not path.is_file():
        return "missing in the folder"
    try:
        with reading(path), opened_image(path) as file:
            gps = file.getexif().get_ifd(ExifTags.IFD.GPSInfo)
    except ImageError:
        return "unreadable"
    except (SyntaxError, ValueError, KeyError, TypeError):
        return "with damaged EXIF data"
    return _position_of(gps)


def _position_of(gps: Mapping[int, Any]) -> Position | str:
    if _TAGS.GPSLatitude not in gps or _TAGS.GPSLongitude not in gps:
        return "without GPS"
    latitude = _degrees(gps, _TAGS.GPSLatitude, _TAGS.GPSLatitudeRef, {"N": 1, "S": -1})
    longitude = _degrees(gps, _TAGS.GPSLongitude, _TAGS.GPSLongitudeRef, {"E": 1, "W": -1})
    if not isfinite(latitude + longitude) or not _is_on_earth(np.array([latitude, longitude, 0.0])):
        return "with an impossible GPS position"
    if latitude == longitude == 0:
        return "with GPS at 0° N 0° E"
    altitude = number(gps.get(_TAGS.GPSAltitude), float("nan"))
    if not isfinite(altitude):
        return "with GPS but without altitude"
    below = _byte(gps.get(_TAGS.GPSAltitudeRef)) in _BELOW_SEA
    return np.array([latitude, longitude, -altitude if below else altitude])


def _degrees(gps: Mapping[int, Any], tag: int, reference: int, signs: Mapping[str, int]) -> float:
    """Degrees from degrees, minutes and seconds; NaN if they are impossible or lack the hemisphere."""
    hemisphere, parts = gps.get(reference), gps[tag]
    sign = signs.get(hemisphere.strip(" \0").upper()[:1]) if isinstance(hemisphere, str) else None
    if sign is None or not isinstance(parts, tuple | list) or not 1 <= len(parts) <= 3:
        return float("nan")
    values = [number(part, float("nan")) for part in parts]
    return sign * sum(value / 60**power for power, value in enumerate(values))


def _byte(value: object) -> int:
    if isinstance(value, bytes):
        return value[0] if value else 0
    return value if isinstance(value, int) else 0
