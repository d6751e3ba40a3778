"""Maps on disk, and the photos of maps without keypoints.

MAP/
  sparse/       COLMAP model, opens in COLMAP, pycolmap and hloc
  features.h5   local features in hloc's layout
  matches.h5    verified matches in hloc's layout; may be missing
  photos.h5     shrunk photos; in maps built without a detector
  global.npz    global descriptors of the images; may be missing
  points.npz    points for direct matching; in reduced maps, often instead of features.h5 and matches.h5
  map.json      format version, extractor and its options, box, unit, origin, notes, orientation, devices
"""

import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from slimsfm.arrays import Image
from slimsfm.devices import Device
from slimsfm.errors import InputError, MapError
from slimsfm.features.store import FeatureFile, FeatureWriter, MatchFile, write_matches
from slimsfm.files import contents_of, replacing, uninterrupted
from slimsfm.files.hdf5 import creating, datasets_of, opened, read_array
from slimsfm.geometry import Box
from slimsfm.mapping.descriptors import (
    read_global_descriptors,
    read_point_descriptors,
    write_global_descriptors,
    write_point_descriptors,
)
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.map import Map, check_map, check_num_features
from slimsfm.mapping.model import num_keypoints, read_model
from slimsfm.mapping.quality import quality_from_json
from slimsfm.photos import Orientation, decode_jpeg, shrink

_QUALITY = 95
_AGAIN = "build the map again"


class PhotoFile(Mapping[str, Image]):
    """The photos in a file by image name, sorted, read on access.

    Raises:
        InputError: The file is missing or damaged, at construction; a photo is damaged, at access.
    """

    def __init__(self, path: Path) -> None:
        self._file, self._path = opened(path), path
        with contents_of(path, "damaged", _AGAIN):
            self._names = dict.fromkeys(sorted(datasets_of(self._file)))

    def __getitem__(self, name: str) -> Image:
        if name not in self._names:
            raise KeyError(name)
        what = f"the photo of {name!r}"
        with contents_of(self._path, f"{what} is damaged", _AGAIN):
            return decode_jpeg(read_array(self._file, name), f"{self._path}: {what}")

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def write_photos(path: Path, photos: Mapping[str, Image]) -> None:
    """Write photos, sorted by name."""
    with creating(path) as file:
        for name in sorted(photos):
            file[name] = _jpeg(photos[name])


def _jpeg(photo: Image) -> np.ndarray:
    bgr = cv2.cvtColor(photo, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].ravel()


def shrink_photo(photo: Image, max_image_size: int) -> UInt8[np.ndarray, "h w 3"]:
    """Shrink a photo to a longer side of at most `max_image_size` pixels, with the losses of JPEG."""
    return np.asarray(cv2.imdecode(_jpeg(shrink(photo, max_image_size)), cv2.IMREAD_COLOR_RGB), np.uint8)


FORMAT_VERSION = 1
"""Version of the format; maps of later versions are rejected."""


def read_map(path: str | Path) -> Map:
    """Read a map; its features are read from disk when they are needed.

    Raises:
        MapError: The folder is not a map, a part is damaged or missing, or the format is of a later version.
    """
    path = Path(path)
    info = _read_info(path)
    try:
        model = read_model(path / "sparse")
        points = path / "points.npz"
        direct = read_point_descriptors(points, model.num_points3D()) if points.exists() else None
        names = sorted(model.image(i).name for i in model.reg_image_ids())
        matches, global_descriptors, photos = (
            path / part for part in ("matches.h5", "global.npz", "photos.h5")
        )
        features = (
            None
            if direct and not (path / "features.h5").exists()
            else FeatureFile(path / "features.h5", names)
        )
        map_ = Map(
            model=model,
            features={} if features is None else features,
            matches=MatchFile(matches, names, num_keypoints(model)) if matches.exists() else {},
            point_descriptors=direct,
            global_descriptors=read_global_descriptors(global_descriptors, len(names))
            if global_descriptors.exists()
            else None,
            photos=PhotoFile(photos) if photos.exists() else {},
            info=info,
        )
        check_map(map_)
        if features is not None:
            for name, image in map_.images.items():
                check_num_features(image, features.count(name))
    except InputError as error:
        raise MapError(f"{path}: not a usable map: {error}") from error
    return map_


def write_map(map: Map, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a map to a folder.

    The map is written next to `path` and renamed, so `path` never holds a part of a map. With `overwrite`, it
    may be the folder that the map was read from.

    Raises:
        OutputError: `path` exists and `overwrite` is off, or it cannot be written.
        MapError: The parts of the map do not belong together.
    """
    check_map(map)
    with replacing(Path(path), overwrite=overwrite) as partial:
        (partial / "sparse").mkdir(parents=True)
        map.model.write(partial / "sparse")
        if map.features:
            _write_features(map, partial / "features.h5")
        if map.matches:
            counts = {name: image.num_points2D() for name, image in map.images.items()}
            write_matches(partial / "matches.h5", map.matches, counts)
        if map.photos:
            write_photos(partial / "photos.h5", map.photos)
        if map.global_descriptors:
            write_global_descriptors(partial / "global.npz", map.global_descriptors)
        if map.point_descriptors:
            write_point_descriptors(partial / "points.npz", map.point_descriptors)
        (partial / "map.json").write_text(json.dumps(_info_to_json(map), indent=2) + "\n")


def _write_features(map: Map, path: Path) -> None:
    with FeatureWriter(path) as writer:
        for name, image in map.images.items():
            features = map.features[name]
            check_num_features(image, len(features))
            writer.write(name, features)


def weigh_map(map: Map) -> int:
    """Size of a map on disk in bytes, measured by writing it to a temporary folder.

    Interruptions are deferred until the folder is removed.
    """
    with uninterrupted(), tempfile.TemporaryDirectory(prefix="slimsfm-weigh-") as folder:
        write_map(map, Path(folder) / "map")
        return bytes_by_part(Path(folder) / "map")["total"]


def bytes_by_part(path: Path) -> dict[str, int]:
    """Size of each part of a map on disk in bytes, and their `total`."""
    sizes = {
        part.name: sum(file.stat().st_size for file in [part, *part.rglob("*")] if file.is_file())
        for part in sorted(path.iterdir())
        if part.name
        in ("sparse", "features.h5", "matches.h5", "photos.h5", "global.npz", "points.npz", "map.json")
    }
    return {**sizes, "total": sum(sizes.values())}


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


def _read_info(path: Path) -> MapInfo:
    file = path / "map.json"
    try:
        data = json.loads(file.read_text())
        version = data["format_version"]
        if version > FORMAT_VERSION:
            raise MapError(
                f"{path}: the map has format {version}, but this slimsfm reads only formats up to "
                f"{FORMAT_VERSION}; upgrade slimsfm"
            )
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
            exif_orientations={
                str(name): int(tag) for name, tag in data.get("exif_orientations", {}).items()
            },
            devices={int(key): _device(device) for key, device in data.get("devices", {}).items()},
        )
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MapError(f"{path}: not a map (it has no map.json); build or import one") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise MapError(f"{file}: damaged ({error}); build or import the map again") from error
