"""Maps on disk, and the photos of maps without keypoints.

MAP/
  sparse/       COLMAP model, opens in COLMAP, pycolmap and hloc
  features.h5   local features in hloc's layout
  matches.h5    verified matches in hloc's layout; may be missing
  photos.h5     shrunk photos; in maps built without a detector
  global.npz    global descriptors of the images; may be missing
  points.npz    points for direct matching; in reduced maps, often instead of features.h5 and matches.h5
  map.json      see `mapping.info_file`
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from slimsfm.arrays import Image
from slimsfm.errors import InputError, MapError
from slimsfm.features.store import FeatureFile, FeatureWriter, MatchFile, write_matches
from slimsfm.files import contents_of, read_unchanged, replacing, uninterrupted, working_folder
from slimsfm.files.checksums import check_files
from slimsfm.files.hdf5 import creating, datasets_of, opened, read_array
from slimsfm.mapping.descriptors import (
    read_global_descriptors,
    read_point_descriptors,
    write_global_descriptors,
    write_point_descriptors,
)
from slimsfm.mapping.info_file import read_info, write_info
from slimsfm.mapping.map import Map, check_map, check_num_features
from slimsfm.mapping.model import num_keypoints, read_model
from slimsfm.photos import decode_jpeg, shrink

_QUALITY = 95
_AGAIN = "build the map again"
_PARTS = "features.h5", "matches.h5", "photos.h5", "global.npz", "points.npz"
_OPTIONAL = "matches.h5", "global.npz"  # may be deleted


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


def read_map(path: str | Path) -> Map:
    """Read a map; its features are read from disk when they are needed.

    Raises:
        MapError: The folder is not a map, a part is damaged or missing, or the format is of a later version.
    """
    path = Path(path)
    try:
        return read_unchanged(path, lambda: _read_map(path))
    except MapError:
        raise
    except InputError as error:
        raise MapError(f"{path}: not a usable map: {error}") from error


def _read_map(path: Path) -> Map:
    info, checksums = read_info(path)
    gone = {name for name in _OPTIONAL if not (path / name).exists()}
    check_files(path, {name: one for name, one in checksums.items() if name not in gone})
    parts = {part.stem: part for part in path.iterdir() if part.name in _PARTS}
    model = read_model(path / "sparse")
    names = sorted(model.image(i).name for i in model.reg_image_ids())
    direct, everywhere, photos = (parts.get(stem) for stem in ("points", "global", "photos"))
    map_ = Map(
        model=model,
        features={} if direct and "features" not in parts else FeatureFile(path / "features.h5", names),
        matches=MatchFile(parts["matches"], names, num_keypoints(model)) if "matches" in parts else {},
        point_descriptors=read_point_descriptors(direct, model.num_points3D()) if direct else None,
        global_descriptors=read_global_descriptors(everywhere, len(names)) if everywhere else None,
        photos=PhotoFile(photos) if photos else {},
        info=info,
    )
    check_map(map_)
    if isinstance(map_.features, FeatureFile):
        for name, image in map_.images.items():
            check_num_features(image, map_.features.count(name))
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
        write_info(map, partial)


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
    with uninterrupted(), working_folder() as folder:
        write_map(map, folder / "map")
        return bytes_by_part(folder / "map")["total"]


def bytes_by_part(path: Path) -> dict[str, int]:
    """Size of each part of a map on disk in bytes, and their `total`."""
    sizes = read_unchanged(path, lambda: _bytes_by_part(path))
    return {**sizes, "total": sum(sizes.values())}


def _bytes_by_part(path: Path) -> dict[str, int]:
    return {
        part.name: sum(file.stat().st_size for file in [part, *part.rglob("*")] if file.is_file())
        for part in sorted(path.iterdir())
        if part.name in ("sparse", "map.json", *_PARTS)
    }
