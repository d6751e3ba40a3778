"""Small reference photos, for matching without keypoints.

`photos.h5` holds one JPEG file per image name.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import h5py
import numpy as np
from jaxtyping import UInt8

from slimsfm.arrays import Image
from slimsfm.errors import InputError
from slimsfm.features.store import creating, opened, read_array
from slimsfm.photos import shrink

_QUALITY = 95


class PhotoFile(Mapping[str, Image]):
    """The photos in a file by image name, sorted, read on access.

    Raises:
        InputError: The file is missing or damaged, at construction; a photo is damaged, at access.
    """

    def __init__(self, path: Path) -> None:
        self._file, self._path = opened(path), path
        found: list[str] = []
        self._file.visititems(
            lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None
        )
        self._names = dict.fromkeys(sorted(found))

    def __getitem__(self, name: str) -> Image:
        if name not in self._names:
            raise KeyError(name)
        try:
            photo = cv2.imdecode(np.asarray(read_array(self._file, name), np.uint8), cv2.IMREAD_COLOR_RGB)
        except (cv2.error, OSError, TypeError, ValueError) as error:
            raise InputError(f"{self._path}: the photo of {name!r} is damaged ({error})") from error
        if photo is None:
            raise InputError(f"{self._path}: the photo of {name!r} is damaged")
        return np.asarray(photo, np.uint8)

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
