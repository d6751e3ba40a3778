"""What is known about a query image in advance: its intrinsics, and the direction of gravity."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.errors import ImageError
from slimsfm.exif import Exif, read_exif
from slimsfm.files import contents_of, plain, read_json
from slimsfm.lenses import camera_fault
from slimsfm.localization.map_cameras import camera_by_exif, camera_of_size, scaled_camera, zoomed_camera
from slimsfm.mapping.map import Map
from slimsfm.pose.priors import Gravity

FocalLength = Literal["auto", "known", "approximate", "unknown"]
"""How well the focal length of a query is known. If it is not known, it is estimated with the pose. auto: as
well as its source says, see `CameraSource`."""

CameraSource = Literal["given", "map", "queries", "exif", "unknown"]
"""Where the intrinsics of a query come from: given by the user, the camera of the map, several queries of one
camera together, EXIF data, or nowhere. The first three are known, EXIF is approximate."""

_GUESS = 1.2  # focal length over the longer side, the default of COLMAP


class UnknownIntrinsicsError(ImageError):
    """Nothing says what the intrinsics of an image are, or what was given is for another image size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryCamera:
    """The intrinsics of a query, and where they come from.

    Raises:
        ValueError: The intrinsics are impossible, see `camera_fault`.
    """

    camera: pycolmap.Camera
    """The intrinsics, of the size of the image."""

    source: CameraSource
    """Where they come from; of the camera of an unknown source, only the size is known."""

    notes: tuple[str, ...] = ()
    """Sentences that name the image, on what was ignored, such as an impossible focal length in EXIF."""

    def __post_init__(self) -> None:
        if fault := camera_fault(self.camera):
            raise ValueError(f"camera must be possible, but {fault}")


def guess_camera(width: int, height: int) -> pycolmap.Camera:
    """The camera of an image of which only the size is known, such as one in memory.

    Returns:
        A SIMPLE_RADIAL camera without distortion, whose focal length is 1.2 times the longer side;
        `has_prior_focal_length` is False.

    Raises:
        ValueError: `width` or `height` is not positive.
    """
    for name, side in (("width", width), ("height", height)):
        if side < 1:
            raise ValueError(f"{name} must be positive, got {side}")
    focal_px = _GUESS * max(width, height)
    return pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal_px, width, height)


def query_camera(
    map: Map, path: str | Path, given: pycolmap.Camera | None, focal: FocalLength = "auto"
) -> QueryCamera:
    """Choose the intrinsics of a query image, read upright or as stored as the map says.

    In this order:

    1. The given camera, scaled to the image.
    2. The camera of the map that fits: by the size, also scaled or held sideways, and by make, model, focal
       length and digital zoom in EXIF, where they are known. Of several, the one of the same model and size
       is taken; if these differ, none.
    3. EXIF: the map's camera with another zoom, or the focal length in EXIF, unless a crop or a digital zoom
       makes it doubtful.
    4. A guess by `guess_camera`, of which only the size is known.

    Args:
        map: The map.
        path: The image.
        given: Intrinsics to use.
        focal: "known" refuses a guess; otherwise the choice is the same for all values.

    Raises:
        UnknownIntrinsicsError: The given camera has another aspect ratio, or the focal length must be known
            but nothing tells it.
        ImageError: The file is not an image.
        ValueError: `focal` is not a value of `FocalLength`.
    """
    path = Path(path)
    if focal not in get_args(FocalLength):
        raise ValueError(f"focal must be one of {', '.join(get_args(FocalLength))}, got {focal!r}")
    exif = read_exif(path)
    size = exif.size(map.info.orientation)
    if given:
        return QueryCamera(camera=_given(given, path, size), source="given")
    notes = _notes(path, exif)
    if camera := camera_by_exif(map, exif):
        return QueryCamera(camera=camera, source="map", notes=notes)
    if camera := zoomed_camera(map, exif) or _by_exif(exif, size):
        return QueryCamera(camera=camera, source="exif", notes=notes)
    if focal == "known":
        raise UnknownIntrinsicsError(
            f"{path}: its focal length is unknown ({exif.problem}, and not taken with {_cameras_of(map)}); "
            "give `camera=FILE`, or estimate it with `focal='unknown'`"
        )
    if exif.doubt:
        notes = (*notes, f"{path}: no focal length is taken from EXIF: {exif.doubt}")
    return QueryCamera(camera=guess_camera(*size), source="unknown", notes=notes)


def camera_in_memory(map: Map, width: int, height: int, given: pycolmap.Camera | None = None) -> QueryCamera:
    """Choose the intrinsics of an image of which only the size is known.

    Args:
        map: The map.
        width: Width of the image, in pixels.
        height: Height of the image, in pixels.
        given: Intrinsics to use; they must be of this size.

    Returns:
        The given camera; else the one camera of the map that has this aspect ratio, of several the one of
        this size; else a guess by `guess_camera`.

    Raises:
        ValueError: The given camera has another size, or the size is not positive.
    """
    if given is not None:
        if (given.width, given.height) != (width, height):
            raise ValueError(
                f"camera must have the image's size {width}x{height}, got {given.width}x{given.height}"
            )
        return QueryCamera(camera=given, source="given")
    if camera := camera_of_size(map, width, height):
        return QueryCamera(camera=camera, source="map")
    return QueryCamera(camera=guess_camera(width, height), source="unknown")


def _given(given: pycolmap.Camera, path: Path, size: tuple[int, int]) -> pycolmap.Camera:
    scaled = scaled_camera(given, *size)
    if scaled is None:
        raise UnknownIntrinsicsError(
            f"{path}: has {size[0]}x{size[1]} pixels, but the given camera {given.width}x{given.height}; "
            "give the camera of this image"
        )
    return scaled


def _by_exif(exif: Exif, size: tuple[int, int]) -> pycolmap.Camera | None:
    focal_px = exif.approximate_focal_px
    if focal_px is None:
        return None
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal_px, *size)
    camera.has_prior_focal_length = True
    return None if camera_fault(camera) else camera


def _notes(path: Path, exif: Exif) -> tuple[str, ...]:
    return (f"{path}: EXIF has {exif.ignored}, which is impossible and ignored",) if exif.ignored else ()


def _cameras_of(map: Map) -> str:
    count = len(map.cameras)
    return "the map's camera" if count == 1 else f"one of the map's {count} cameras alone"


def read_gravity(path: str | Path) -> dict[str, Gravity]:
    """Read the direction of gravity per image, which phones record with their photos, from a JSON file.

    The file holds `{"world": [x, y, z], "images": {NAME: [x, y, z], ...}}`. The first vector points down in
    the frame of the map, the others in the camera frames of the images (x right, y down, z forward), upright
    or as stored as the map says. Vectors may have any length.

    Raises:
        InputError: The file is missing or has other contents.
    """
    path = Path(path)
    with contents_of(path, 'should hold {"world": [x, y, z], "images": {NAME: [x, y, z], ...}}'):
        data = read_json(path)
        world = _vector(data["world"])
        return {str(name): Gravity(in_world=world, in_cam=_vector(v)) for name, v in data["images"].items()}


def _vector(values: object) -> Float64[np.ndarray, "3"]:
    return np.array(plain(values, list[float]), np.float64).reshape(3)
