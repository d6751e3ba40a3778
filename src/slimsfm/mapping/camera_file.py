"""Read the intrinsics of a camera from a file."""

from pathlib import Path

import pycolmap

from slimsfm.errors import InputError
from slimsfm.files import contents_of, read_text
from slimsfm.lenses import camera_fault


def read_camera(path: str | Path) -> pycolmap.Camera:
    """Read the one camera of a file in COLMAP's `cameras.txt` format: `ID MODEL WIDTH HEIGHT PARAMS...`.

    Raises:
        InputError: The file is missing, does not hold exactly one camera, or an impossible one.
    """
    path = Path(path)
    with contents_of(path, "not a readable camera file"):
        lines = [line.split() for line in read_text(path).splitlines()]
    cameras = [words for words in lines if words and not words[0].startswith("#")]
    try:
        (camera,) = cameras
        camera_id, model, width, height, *params = camera
        read = pycolmap.Camera.create_from_model_name(int(camera_id), model, 1.0, int(width), int(height))
        read.params = [float(p) for p in params]
    except (ValueError, TypeError, RuntimeError, AttributeError) as error:
        raise InputError(
            f"{path}: should hold one line `ID MODEL WIDTH HEIGHT PARAMS...` as in COLMAP's cameras.txt"
        ) from error
    if fault := camera_fault(read):
        raise InputError(f"{path}: the camera is impossible: {fault}; correct the line or calibrate it again")
    return read
