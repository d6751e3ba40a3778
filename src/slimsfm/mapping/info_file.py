"""What a map says of itself, on disk: `map.json`, with checksums of itself and of the map's other files."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float64

from slimsfm.devices import Device
from slimsfm.errors import MapError
from slimsfm.files.checksums import COPY_AGAIN, checksum_of_json, checksums_of
from slimsfm.geometry import Box
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.map import Map
from slimsfm.mapping.quality import quality_from_json
from slimsfm.photos import Orientation

FORMAT_VERSION = 1
"""Version of the format; maps of later versions are rejected."""

_NAME = "map.json"


class StoredInfo(NamedTuple):
    """The contents of a map.json."""

    info: MapInfo
    """What the map says of itself."""

    checksums: dict[str, dict[str, Any]]
    """Size and CRC-32 of the other files, by path within the map; empty in older maps."""


def write_info(map: Map, folder: Path) -> None:
    """Write the map.json of a map whose other files are in a folder already."""
    data = _info_to_json(map)
    checksums = checksums_of(folder)
    data["checksums"] = {**checksums, _NAME: {"crc32": checksum_of_json({**data, "checksums": checksums})}}
    (folder / _NAME).write_text(json.dumps(data, indent=2) + "\n")


def _info_to_json(map: Map) -> dict:
    info = map.info
    used = {image.camera_id for image in map.images.values()}
    devices = {str(key): asdict(device) for key, device in sorted(info.devices.items()) if key in used}
    tags = {name: info.exif_orientations[name] for name in map.images if name in info.exif_orientations}
    return {
        "format_version": FORMAT_VERSION,
        "extractor": {"name": info.extractor, "options": info.extractor_options},
        "box": {
            "center": info.box.center.tolist(),
            "half_edges": info.box.half_edges.tolist(),
            "source": info.box_source,
        },
        "unit": info.unit,
        "origin": info.origin,
        "notes": list(info.notes),
        "orientation": info.orientation,
        **({"exif_orientations": tags} if tags else {}),
        **({"devices": devices} if devices else {}),
        "quality": None if info.quality is None else asdict(info.quality),
    }


def _numbers(values: list, *shape: int) -> Float64[np.ndarray, "..."]:
    return np.array(values, np.float64).reshape(shape)


def _device(data: dict) -> Device:
    return Device(
        make=str(data["make"]),
        model=str(data["model"]),
        focal_mm=float(data["focal_mm"]),
        focal_35mm=float(data["focal_35mm"]),
        digital_zoom=float(data["digital_zoom"]),
    )


def _orientation(value: object) -> Orientation:
    for known in get_args(Orientation):
        if value == known:
            return known
    raise ValueError(f"orientation must be one of {', '.join(get_args(Orientation))}, got {value!r}")


def read_info(path: Path) -> StoredInfo:
    """Read the map.json in the folder of a map, and check it by its own checksum.

    Raises:
        MapError: The folder has none, or it is damaged or of a later version.
    """
    file = path / _NAME
    try:
        data = json.loads(file.read_text())
        version = data["format_version"]
        if version > FORMAT_VERSION:
            raise MapError(
                f"{path}: the map has format {version}, but this slimsfm reads only formats up to "
                f"{FORMAT_VERSION}; upgrade slimsfm"
            )
        stored = StoredInfo(_info_from_json(data), dict(data.get("checksums", {})))
        is_whole = not stored.checksums or _has_its_checksum(data, stored.checksums)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MapError(f"{path}: not a map (it has no map.json); build or import one") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise MapError(f"{file}: damaged ({error}); build or import the map again") from error
    if not is_whole:
        raise MapError(f"{file}: damaged: its contents do not have the stored checksum; {COPY_AGAIN}")
    return stored


def _has_its_checksum(data: dict[str, Any], checksums: dict[str, dict[str, Any]]) -> bool:
    """Whether a map.json is as it was written; takes its own checksum out of `checksums`."""
    expected = checksums.pop(_NAME)["crc32"]
    return checksum_of_json({**data, "checksums": checksums}) == expected


def _info_from_json(data: dict[str, Any]) -> MapInfo:
    return MapInfo(
        extractor=data["extractor"]["name"],
        extractor_options=data["extractor"]["options"],
        box=Box(_numbers(data["box"]["center"], 3), _numbers(data["box"]["half_edges"], 3, 3)),
        box_source=data["box"]["source"],
        unit=data["unit"],
        origin=data["origin"],
        notes=tuple(map(str, data.get("notes", ()))),
        quality=quality_from_json(data.get("quality")),
        orientation=_orientation(data.get("orientation", "upright")),
        exif_orientations={str(name): int(tag) for name, tag in data.get("exif_orientations", {}).items()},
        devices={int(key): _device(device) for key, device in data.get("devices", {}).items()},
    )
