"""What is known about a query image in advance: its intrinsics, and the direction of gravity."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.errors import ImageError, InputError
from slimsfm.exif import read_exif
from slimsfm.mapping.map import Map
from slimsfm.pose.types import Gravity

FocalLength = Literal["auto", "known", "approximate", "unknown"]
"""How well the focal length of a query is known. If it is not known, it is estimated with the pose. auto: as
well as its source says, see `CameraSource`."""

CameraSource = Literal["given", "map", "exif", "unknown"]
"""Where the intrinsics of a query come from: given by the user, the camera of the map, EXIF data, or nowhere.
The first two are known, EXIF is approximate."""

_GUESS = 1.2  # focal length over the longer side, the default of COLMAP
_SAME_FOCAL = 0.1  # relative difference below which EXIF means the map's camera, whose calibration is better


class UnknownIntrinsicsError(ImageError):
    """Nothing says what the intrinsics of an image are, or what was given is for another image size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryCamera:
    """The intrinsics of a query, and where they come from."""

    camera: pycolmap.Camera
    """The intrinsics, of the size of the image."""

    source: CameraSource
    """Where they come from; of the camera of an unknown source, only the size is known."""

    notes: tuple[str, ...] = ()
    """Sentences that name the image, on what was ignored, such as an impossible focal length in EXIF."""


def read_camera(path: str | Path) -> pycolmap.Camera:
    """Read the one camera of a file in COLMAP's `cameras.txt` format: `ID MODEL WIDTH HEIGHT PARAMS...`.

    Raises:
        InputError: The file is missing, or does not hold exactly one camera.
    """
    path = Path(path)
    try:
        lines = [line.split() for line in path.read_text("utf-8-sig").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a readable camera file ({error})") from error
    cameras = [words for words in lines if words and not words[0].startswith("#")]
    try:
        (camera,) = cameras
        camera_id, model, width, height, *params = camera
        read = pycolmap.Camera.create_from_model_name(int(camera_id), model, 1.0, int(width), int(height))
        read.params = [float(p) for p in params]
        if _is_usable(read):
            return read
        raise ValueError("not this model's parameters")
    except (ValueError, TypeError, RuntimeError, AttributeError) as error:
        raise InputError(
            f"{path}: should hold one line `ID MODEL WIDTH HEIGHT PARAMS...` as in COLMAP's cameras.txt"
        ) from error


def _is_usable(camera: pycolmap.Camera) -> bool:
    if not camera.verify_params() or min(camera.width, camera.height) < 1:
        return False
    focal_lengths = camera.params[camera.focal_length_idxs()]
    return bool(np.all(np.isfinite(camera.params)) and len(focal_lengths) and np.all(focal_lengths > 0))


def scaled_camera(camera: pycolmap.Camera, width: int, height: int) -> pycolmap.Camera | None:
    """The camera of an image resized to this size; None if the aspect ratio differs."""
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        return None
    scaled = pycolmap.Camera(camera.todict())
    scaled.rescale(width, height)
    return scaled


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

    In this order: the given camera; the map's; that of EXIF; a guess by `guess_camera`.

    Raises:
        UnknownIntrinsicsError: The given camera has another aspect ratio, or the focal length must be known
            but nothing tells it.
        ImageError: The file is not an image.
        ValueError: `focal` is not a value of `FocalLength`.
    """
    path = Path(path)
    if focal not in get_args(FocalLength):
        raise ValueError(f"focal must be one of {', '.join(get_args(FocalLength))}, got {focal!r}")
    found = read_exif(path)
    exif = found.camera(map.info.orientation)
    candidate = given or map.shared_camera
    scaled = candidate and scaled_camera(candidate, exif.width, exif.height)
    if given and scaled is None:
        raise UnknownIntrinsicsError(
            f"{path}: has {exif.width}x{exif.height} pixels, but the given camera "
            f"{given.width}x{given.height}; give the camera of this image"
        )
    if scaled and (given or not exif.has_prior_focal_length or _same_focal(exif, scaled)):
        return QueryCamera(camera=scaled, source="given" if given else "map")
    if exif.has_prior_focal_length:
        return QueryCamera(camera=exif, source="exif")
    if focal == "known":
        raise UnknownIntrinsicsError(
            f"{path}: its focal length is unknown ({found.problem}, and not taken with the map's camera); "
            "give `camera=FILE`, or estimate it with `focal='unknown'`"
        )
    return QueryCamera(camera=guess_camera(exif.width, exif.height), source="unknown")


def camera_in_memory(map: Map, width: int, height: int, given: pycolmap.Camera | None = None) -> QueryCamera:
    """Choose the intrinsics of an image of which only the size is known.

    Args:
        map: The map.
        width: Width of the image, in pixels.
        height: Height of the image, in pixels.
        given: Intrinsics to use; they must be of this size.

    Returns:
        The given camera; else the one camera of the map that has this aspect ratio; else a guess.

    Raises:
        ValueError: The given camera has another size, or the size is not positive.
    """
    if given is not None and (given.width, given.height) != (width, height):
        raise ValueError(
            f"camera must have the image's size {width}x{height}, got {given.width}x{given.height}"
        )
    if given is not None:
        return QueryCamera(camera=given, source="given")
    shared = map.shared_camera
    scaled = shared and scaled_camera(shared, width, height)
    if scaled:
        return QueryCamera(camera=scaled, source="map")
    return QueryCamera(camera=guess_camera(width, height), source="unknown")


def _same_focal(a: pycolmap.Camera, b: pycolmap.Camera) -> bool:
    return abs(a.mean_focal_length() / b.mean_focal_length() - 1) < _SAME_FOCAL


def read_gravity(path: str | Path) -> dict[str, Gravity]:
    """Read the direction of gravity per image, which phones record with their photos, from a JSON file.

    The file holds `{"world": [x, y, z], "images": {NAME: [x, y, z], ...}}`. The first vector points down in
    the frame of the map, the others in the camera frames of the images (x right, y down, z forward), upright
    or as stored as the map says. Vectors may have any length.

    Raises:
        InputError: The file is missing or has other contents.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text("utf-8-sig"))
        world = _vector(data["world"])
        return {str(name): Gravity(in_world=world, in_cam=_vector(v)) for name, v in data["images"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f'{path}: should hold {{"world": [x, y, z], "images": {{NAME: [x, y, z], ...}}}} ({error})'
        ) from error


def _vector(values: object) -> Float64[np.ndarray, "3"]:
    return np.array(values, np.float64).reshape(3)
