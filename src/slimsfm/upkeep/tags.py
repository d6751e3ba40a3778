"""Printed square tags (ArUco, AprilTag) in photos, as OpenCV finds them."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Float64

from slimsfm.arrays import GrayImage
from slimsfm.errors import InputError
from slimsfm.files import inside
from slimsfm.mapping.map import Map
from slimsfm.photos import read_photo
from slimsfm.progress import ProgressBar, silent

Family = Literal[
    "apriltag-36h11",
    "apriltag-25h9",
    "apriltag-16h5",
    "aruco-4x4",
    "aruco-5x5",
    "aruco-6x6",
    "aruco-7x7",
    "aruco-original",
]
"""Families of tags. Those of ArUco are the dictionaries of 1000 tags, which hold the smaller ones."""

_DICTIONARIES = {
    "apriltag-36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "apriltag-25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "apriltag-16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "aruco-4x4": cv2.aruco.DICT_4X4_1000,
    "aruco-5x5": cv2.aruco.DICT_5X5_1000,
    "aruco-6x6": cv2.aruco.DICT_6X6_1000,
    "aruco-7x7": cv2.aruco.DICT_7X7_1000,
    "aruco-original": cv2.aruco.DICT_ARUCO_ORIGINAL,
}
_HALF_PIXEL = 0.5  # from OpenCV's pixels to COLMAP's
_TRIED = 10  # photos in which other families are looked for

Corners = Float64[np.ndarray, "4 2"]


@dataclass(frozen=True, kw_only=True, eq=False)
class TagView:
    """A tag in a photo of the map."""

    image: str
    """Name of the photo."""

    corners: Corners
    """Pixels of the corners of its black square, clockwise from the tag's top left."""


def find_tags(
    map: Map, images: str | Path, family: Family = "apriltag-36h11", *, progress: ProgressBar = silent
) -> dict[int, list[TagView]]:
    """Find the tags of a family in the photos of a map, with corners to a fraction of a pixel.

    Args:
        map: The map.
        images: Folder of its photos.
        family: Family of the tags.
        progress: Progress bar, one step per photo.

    Returns:
        The views of each tag by its number, both sorted. A tag that is twice in one photo is left out there.

    Raises:
        InputError: No photo of the map is in the folder, a photo has another size than its camera, or there
            is no such tag.
        ImageError: A photo cannot be read.
    """
    if family not in get_args(Family):
        raise ValueError(f"family must be one of {', '.join(get_args(Family))}, got {family!r}")
    folder = Path(images)
    there = [name for name in map.images if inside(folder, name).is_file()]
    if not there:
        raise InputError(
            f"{folder}: holds none of the map's {len(map.images)} photos, such as "
            f"{next(iter(map.images))!r}; give the folder that the map was built from"
        )
    detector, found = _detector(family), dict[int, list[TagView]]()
    for name in progress(there, "look for tags"):
        for number, corners in _tags_in(_photo(map, folder, name), detector).items():
            found.setdefault(number, []).append(TagView(image=name, corners=corners))
    if not found:
        others = _other_families(map, folder, there[:: max(1, len(there) // _TRIED)], family)
        hint = f"; there are tags of {others}" if others else "; take photos of it from nearer"
        raise InputError(
            f"{folder}: no tag of the family {family} in the {len(there)} photos of the map{hint}"
        )
    return dict(sorted(found.items()))


def _photo(map: Map, folder: Path, name: str) -> GrayImage:
    path, camera = inside(folder, name), map.camera(name)
    rgb = read_photo(path, map.info.orientation).image
    if rgb.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"{path}: has {rgb.shape[1]}x{rgb.shape[0]} pixels, but its camera in the map "
            f"{camera.width}x{camera.height}; give the photos that the map was built from"
        )
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def _detector(family: Family) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(_DICTIONARIES[family]), parameters)


def _tags_in(photo: GrayImage, detector: cv2.aruco.ArucoDetector) -> dict[int, Corners]:
    """Corners by number; numbers that are there twice are left out."""
    corners, numbers, _ = detector.detectMarkers(photo)
    if numbers is None:
        return {}
    listed = np.asarray(numbers).ravel().tolist()
    return {
        int(number): np.asarray(one, np.float64).reshape(4, 2) + _HALF_PIXEL
        for number, one in zip(listed, corners, strict=True)
        if listed.count(number) == 1
    }


def _other_families(map: Map, folder: Path, names: Iterable[str], family: Family) -> str:
    """The families that some photos show, most tags first."""
    photos = [_photo(map, folder, name) for name in names]
    counts = {
        other: sum(len(_tags_in(photo, _detector(other))) for photo in photos)
        for other in get_args(Family)
        if other != family
    }
    return " or ".join(sorted((one for one in counts if counts[one] > 1), key=lambda one: -counts[one])[:2])
