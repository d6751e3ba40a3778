"""Check binary files of COLMAP models before pycolmap reads them.

pycolmap trusts the counts in a binary file: a truncated file makes it run out of memory or abort the process.
So each file is first walked record by record, as COLMAP's "Output Format" describes.
"""

import struct
from collections.abc import Callable
from pathlib import Path

import pycolmap

from slimsfm.errors import ModelError

_CAMERA, _POSE, _POINT2D = 24, 56, 24  # bytes: id, model, width, height; quaternion and translation; x, y, id
_TRACK_ELEMENT, _SENSOR, _DATA = 8, 8, 16


MODEL_PARTS = ("cameras", "rigs", "frames", "images", "points3D")
"""The files of a model; those from before rigs and frames lack these two."""


def check_binary(file: Path) -> None:
    """Check that a file of a model, such as images.bin, consists of whole records; it may be missing.

    Raises:
        ModelError: It does not.
    """
    if not file.is_file():
        return
    walk = _WALKS[file.stem]
    data = memoryview(file.read_bytes())
    try:
        (count,) = struct.unpack_from("<Q", data, 0)
        position = 8
        for _ in range(count):
            position = walk(data, position)
            if position > len(data):
                raise ValueError
    except (struct.error, ValueError, IndexError, KeyError):
        raise ModelError(
            f"{file}: damaged or cut short ({len(data)} bytes); copy or export the model again"
        ) from None
    if position != len(data):
        raise ModelError(f"{file}: {len(data) - position} bytes too long; copy or export the model again")


def _walk_camera(data: memoryview, position: int) -> int:
    model = pycolmap.CameraModelId(struct.unpack_from("<i", data, position + 4)[0])
    params = pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params
    return position + _CAMERA + 8 * len(params)


def _walk_image(data: memoryview, position: int) -> int:
    end = position + 4 + _POSE + 4
    while data[end] != 0:
        end += 1
    (num_points2D,) = struct.unpack_from("<Q", data, end + 1)
    return end + 9 + _POINT2D * num_points2D


def _walk_point3D(data: memoryview, position: int) -> int:
    (track_length,) = struct.unpack_from("<Q", data, position + 43)
    return position + 51 + _TRACK_ELEMENT * track_length


def _walk_rig(data: memoryview, position: int) -> int:
    (num_sensors,) = struct.unpack_from("<I", data, position + 4)
    position += 8 + (_SENSOR if num_sensors else 0)
    for _ in range(num_sensors - 1):
        position += _SENSOR + 1 + (_POSE if data[position + _SENSOR] else 0)
    return position


def _walk_frame(data: memoryview, position: int) -> int:
    (num_data,) = struct.unpack_from("<I", data, position + 8 + _POSE)
    return position + 12 + _POSE + _DATA * num_data


Walk = Callable[[memoryview, int], int]
"""Takes the bytes of a file and the start of a record, and returns the start of the next record."""

_WALKS: dict[str, Walk] = {
    "cameras": _walk_camera,
    "rigs": _walk_rig,
    "frames": _walk_frame,
    "images": _walk_image,
    "points3D": _walk_point3D,
}
