"""What a map says of itself, on disk: `map.json`, with checksums of itself and of the map's other files."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from slimsfm.devices import Device
from slimsfm.errors import InputError, MapError
from slimsfm.files import contents_of, plain, read_json
from slimsfm.files.checksums import COPY_AGAIN, Checksum, checksum_of_json, checksums_of
from slimsfm.geometry import Box
from slimsfm.mapping.georeference import Georeference
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.map import Map
from slimsfm.mapping.quality import quality_from_json
from slimsfm.photos import Orientation

FORMAT_VERSION = 2
"""Version of the format; maps of later versions are rejected."""

_ONE_DESCRIPTOR = 1  # version of maps whose points have one descriptor each, which older programs read too

_NAME = "map.json"


class StoredInfo(NamedTuple):
    """The contents of a map.json."""

    info: MapInfo
    """What the map says of itself."""

    checksums: dict[str, Checksum]
    """Checksums of the other files, by path within the map; empty in older maps."""


def write_info(map: Map, folder: Path) -> None:
    """Write the map.json of a map whose other files are in a folder already."""
    checksums = {name: asdict(one) for name, one in checksums_of(folder).items()}
    data = {**_info_to_json(map), "checksums": checksums}
    checksums[_NAME] = {"crc32": _own_checksum(data)}
    (folder / _NAME).write_text(json.dumps(data, indent=2) + "\n")


def _format_version(map: Map) -> int:
    described = map.point_descriptors
    is_older = described is None or len(described.firsts) == len(described.points)
    return _ONE_DESCRIPTOR if is_older else FORMAT_VERSION


def _info_to_json(map: Map) -> dict:
    info = map.info
    used = {image.camera_id for image in map.images.values()}
    devices = {str(key): asdict(device) for key, device in sorted(info.devices.items()) if key in used}
    tags = {name: info.exif_orientations[name] for name in map.images if name in info.exif_orientations}
    return {
        "format_version": _format_version(map),
        "extractor": {"name": info.extractor, "options": info.extractor_options},
        "box": {
            "center": info.box.center.tolist(),
            "half_edges": info.box.half_edges.tolist(),
            "source": info.box_source,
        },
        "unit": info.unit,
        **({"georeference": info.georeference.to_json()} if info.georeference else {}),
        "origin": info.origin,
        "notes": list(info.notes),
        "orientation": info.orientation,
        **({"exif_orientations": tags} if tags else {}),
        **({"devices": devices} if devices else {}),
        **({"first_image_size": info.first_image_size} if info.first_image_size else {}),
        "quality": None if info.quality is None else asdict(info.quality),
    }


def read_info(path: Path) -> StoredInfo:
    """Read the map.json in the folder of a map, and check it by its own checksum.

    Raises:
        MapError: The folder has none, or it is damaged or of a later version.
    """
    file = path / _NAME
    if not os.path.isfile(file):  # Path.is_file raises errors for names that are too long
        raise MapError(f"{path}: not a map (it has no map.json); build or import one")
    try:
        with contents_of(file, "damaged", "build or import the map again"):
            data = read_json(file)
            _check_version(data["format_version"], path)
            info = _info_from_json(data)
            checksums = plain(data.get("checksums", {}), dict[str, Checksum])
            own = checksums.pop(_NAME).crc32 if checksums else ""
        if own and own != _own_checksum(data):
            raise MapError(f"{file}: damaged: its contents do not have the stored checksum; {COPY_AGAIN}")
    except MapError:
        raise
    except InputError as error:
        raise MapError(str(error)) from error
    return StoredInfo(info, checksums)


def _check_version(version: int, path: Path) -> None:
    if version > FORMAT_VERSION:
        raise MapError(
            f"{path}: the map has format {version}, but this slimsfm reads only formats up to "
            f"{FORMAT_VERSION}; upgrade slimsfm"
        )


def _own_checksum(data: dict[str, Any]) -> str:
    """The checksum of a map.json, of all that it holds but the checksum itself."""
    others = {name: one for name, one in data.get("checksums", {}).items() if name != _NAME}
    return checksum_of_json({**data, "checksums": others})


def _info_from_json(data: dict[str, Any]) -> MapInfo:
    devices = plain(data.get("devices", {}), dict[str, Device])
    return MapInfo(
        extractor=data["extractor"]["name"],
        extractor_options=data["extractor"]["options"],
        box=Box(_numbers(data["box"]["center"], 3), _numbers(data["box"]["half_edges"], 3, 3)),
        box_source=data["box"]["source"],
        unit=data["unit"],
        georeference=Georeference.from_json(data.get("georeference")),
        origin=data["origin"],
        notes=plain(data.get("notes", ()), tuple[str, ...]),
        quality=quality_from_json(data.get("quality")),
        orientation=plain(data.get("orientation", "upright"), Orientation),
        exif_orientations=plain(data.get("exif_orientations", {}), dict[str, int]),
        first_image_size=plain(data.get("first_image_size"), int | None),
        devices={int(key): device for key, device in devices.items()},
    )


def _numbers(values: list, *shape: int) -> Float64[np.ndarray, "..."]:
    return np.array(values, np.float64).reshape(shape)
