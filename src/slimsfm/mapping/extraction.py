"""Cameras, local features and colors of a folder of photos."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import UInt8

from slimsfm.errors import InputError
from slimsfm.features import Extractor, image_colors
from slimsfm.features.store import FeatureFile, FeatureWriter
from slimsfm.mapping.masked_photos import MaskedPhotos
from slimsfm.photos import camera_from_exif
from slimsfm.progress import ProgressBar

CameraSharing = Literal["auto", "shared", "per-image"]

Colors = Mapping[str, UInt8[np.ndarray, "n 3"]]
"""RGB at each keypoint, by image name."""


def guess_cameras(images: Path, names: list[str], sharing: CameraSharing) -> dict[str, pycolmap.Camera]:
    """Guess the camera of each image from EXIF; images with equal `camera_id` share a camera.

    With "auto", images of equal size and focal length share a camera; with "shared" all do, with "per-image"
    none.

    Raises:
        InputError: An image cannot be read, or images of different sizes share a camera.
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
            f"{a} has {size_a[0]}x{size_a[1]} pixels, {b} {size_b[0]}x{size_b[1]}; "
            "images that share a camera must have the same size, so use `camera='auto'`"
        )


def extract_features(
    photos: MaskedPhotos, names: list[str], extractor: Extractor, output: Path, progress: ProgressBar
) -> tuple[FeatureFile, Colors]:
    """Extract the features of images to a file.

    Raises:
        InputError: An image cannot be read, its mask is unreadable or of another size, or masks leave fewer
            than two images with pixels.
    """
    colors = {}
    with FeatureWriter(output) as writer:
        for name in progress(names, "extract features"):
            photo = photos.read(name)
            features = extractor.extract(photo.image, photo.mask)
            colors[name] = image_colors(photo.image, features.keypoints)
            writer.write(name, features)
    photos.check()
    return FeatureFile(output), colors


def color_points(model: pycolmap.Reconstruction, colors: Colors) -> None:
    """Set the color of each point to the mean color of its observations."""
    names = {image_id: image.name for image_id, image in model.images.items()}
    for point in model.points3D.values():
        seen = [colors[names[element.image_id]][element.point2D_idx] for element in point.track.elements]
        point.color = np.mean(seen, axis=0).round().astype(np.uint8)
