"""Which intrinsics a query has: given, those of the map, or told by EXIF."""

from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.errors import ImageError, InputError
from slimsfm.mapping.map import Map
from slimsfm.photos import camera_from_exif

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


def query_camera(map: Map, path: Path, given: pycolmap.Camera | None) -> pycolmap.Camera:
    """Choose the intrinsics of a query image.

    The given camera if there is one; else the camera that all reference images share, unless EXIF tells of
    another focal length or the image is of another shape; else what EXIF tells.

    Raises:
        ImageError: None of these serves.
    """
    exif = camera_from_exif(path)
    candidate = given or map.shared_camera
    scaled = candidate and scaled_camera(candidate, exif.width, exif.height)
    if given and scaled is None:
        raise ImageError(
            f"{path}: has {exif.width}x{exif.height} pixels, its --camera {given.width}x{given.height}; "
            "give the camera of this image"
        )
    if scaled and (given or not exif.has_prior_focal_length or _same_focal(exif, scaled)):
        return scaled
    if exif.has_prior_focal_length:
        return exif
    raise ImageError(
        f"{path}: its focal length is unknown (no EXIF, and not of the map's camera); give --camera FILE"
    )


def _same_focal(a: pycolmap.Camera, b: pycolmap.Camera) -> bool:
    return abs(a.mean_focal_length() / b.mean_focal_length() - 1) < _SAME_FOCAL
