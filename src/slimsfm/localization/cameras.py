"""Which intrinsics a query has: given, those of the map, told by EXIF, or guessed."""

from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pycolmap

from slimsfm.errors import ImageError, InputError
from slimsfm.mapping.map import Map
from slimsfm.photos import camera_from_exif

FocalLength = Literal["known", "approximate", "unknown"]
"""How well the focal length of a query is known; unless it is, it is estimated with the pose."""

_GUESS = 1.2  # focal length over the longer side, as COLMAP guesses
_SAME_FOCAL = 0.1  # relative difference up to which EXIF speaks of the map's camera, calibrated there better


def read_camera(path: Path) -> pycolmap.Camera:
    """Read the one camera of a file in COLMAP's `cameras.txt` format: `ID MODEL WIDTH HEIGHT PARAMS...`.

    Raises:
        InputError: The file is missing, or does not hold one camera.
    """
    try:
        lines = [line.split() for line in path.read_text().splitlines()]
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
            f"{path}: should hold one line `ID MODEL WIDTH HEIGHT PARAMS...` as COLMAP's cameras.txt has it"
        ) from error


def _is_usable(camera: pycolmap.Camera) -> bool:
    if not camera.verify_params() or min(camera.width, camera.height) < 1:
        return False
    focal_lengths = camera.params[camera.focal_length_idxs()]
    return bool(np.all(np.isfinite(camera.params)) and len(focal_lengths) and np.all(focal_lengths > 0))


def scaled_camera(camera: pycolmap.Camera, width: int, height: int) -> pycolmap.Camera | None:
    """The camera of an image resized to this size; None where the sides' ratio is another."""
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        return None
    scaled = pycolmap.Camera(camera.todict())
    scaled.rescale(width, height)
    return scaled


def guess_camera(width: int, height: int) -> pycolmap.Camera:
    """The camera of an image of which nothing but the size is known, such as one in memory.

    Returns:
        A SIMPLE_RADIAL camera without distortion, its focal length 1.2 times the longer side;
        `has_prior_focal_length` is False.

    Raises:
        ValueError: A side is not positive.
    """
    for name, side in (("width", width), ("height", height)):
        if side < 1:
            raise ValueError(f"{name} must be positive, got {side}")
    focal_px = _GUESS * max(width, height)
    return pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal_px, width, height)


def query_camera(
    map: Map, path: Path, given: pycolmap.Camera | None, focal: FocalLength = "known"
) -> pycolmap.Camera:
    """Choose the intrinsics of a query image.

    The given camera if there is one; else the camera that all reference images share, unless EXIF tells of
    another focal length or the image is of another shape; else what EXIF tells; else, where the focal length
    need not be known, a guess of 1.2 times the longer side.

    Raises:
        ImageError: None of these serves.
        ValueError: `focal` is none of its values.
    """
    if focal not in get_args(FocalLength):
        raise ValueError(f"focal must be one of {', '.join(get_args(FocalLength))}, got {focal!r}")
    exif = camera_from_exif(path)
    candidate = given or map.shared_camera
    scaled = candidate and scaled_camera(candidate, exif.width, exif.height)
    if given and scaled is None:
        raise ImageError(
            f"{path}: has {exif.width}x{exif.height} pixels, its camera {given.width}x{given.height}; "
            "give the camera of this image"
        )
    if scaled and (given or not exif.has_prior_focal_length or _same_focal(exif, scaled)):
        return scaled
    if exif.has_prior_focal_length:
        return exif
    if focal == "known":
        raise ImageError(
            f"{path}: its focal length is unknown (no EXIF, and not of the map's camera); "
            "give `camera=FILE`, or have it estimated with `focal='unknown'`"
        )
    return guess_camera(exif.width, exif.height)


def _same_focal(a: pycolmap.Camera, b: pycolmap.Camera) -> bool:
    return abs(a.mean_focal_length() / b.mean_focal_length() - 1) < _SAME_FOCAL
