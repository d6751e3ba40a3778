"""Which images share a camera."""

from pathlib import Path
from typing import Literal

import pycolmap

from slimsfm.errors import InputError
from slimsfm.photos import camera_from_exif

CameraSharing = Literal["auto", "shared", "per-image"]


def guess_cameras(images: Path, names: list[str], sharing: CameraSharing) -> dict[str, pycolmap.Camera]:
    """Guess the camera of each image from EXIF; images with equal `camera_id` share one.

    "auto" puts images of equal size and focal length together, "shared" all, "per-image" none.

    Raises:
        InputError: An image cannot be read, or images of several sizes should share one camera.
    """
    guesses = {name: camera_from_exif(images / name) for name in names}
    if sharing == "shared":
        _check_equal_sizes(guesses)
    first: dict[tuple, pycolmap.Camera] = {}
    for name, camera in guesses.items():
        camera.camera_id = len(first) + 1
        first.setdefault(_key(name, camera, sharing), camera)
    return {name: first[_key(name, camera, sharing)] for name, camera in guesses.items()}


def _key(name: str, camera: pycolmap.Camera, sharing: CameraSharing) -> tuple:
    if sharing == "shared":
        return ()
    if sharing == "per-image":
        return (name,)
    return (camera.width, camera.height, round(camera.focal_length, 2))


def _check_equal_sizes(guesses: dict[str, pycolmap.Camera]) -> None:
    sizes = {(camera.width, camera.height): name for name, camera in guesses.items()}
    if len(sizes) > 1:
        (size_a, a), (size_b, b) = list(sizes.items())[:2]
        raise InputError(
            f"`camera='shared'`: {a} has {size_a[0]}x{size_a[1]} pixels, {b} {size_b[0]}x{size_b[1]}; "
            "images of one camera have one size, so use `camera='auto'`"
        )
