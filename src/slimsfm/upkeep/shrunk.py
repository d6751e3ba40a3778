"""Models in the pixels in which features were found, which COLMAP's limits are for."""

from collections.abc import Iterable, Mapping
from typing import Any

import pycolmap

from slimsfm.features import shrink_factor
from slimsfm.geometry import resized_camera


def shrunk_model(
    model: pycolmap.Reconstruction, extractor_options: Mapping[str, Any]
) -> pycolmap.Reconstruction:
    """A copy of a model in the pixels of images as an extractor with these options shrinks them."""
    small = pycolmap.Reconstruction(model)
    factors = {i: _factor(camera, extractor_options) for i, camera in model.cameras.items()}
    for camera_id, factor in factors.items():
        if factor != 1:
            _set(small.camera(camera_id), resized_camera(model.camera(camera_id), 1 / factor))
    for image in small.images.values():
        if (factor := factors[image.camera_id]) != 1:
            for point in image.points2D:
                point.xy = point.xy / factor
    return small


def take_cameras(
    small: pycolmap.Reconstruction,
    model: pycolmap.Reconstruction,
    camera_ids: Iterable[int],
    extractor_options: Mapping[str, Any],
) -> None:
    """Give some cameras of a model the intrinsics that they have in a copy by `shrunk_model`."""
    for camera_id in camera_ids:
        camera = model.camera(camera_id)
        width, height = camera.width, camera.height
        _set(camera, resized_camera(small.camera(camera_id), _factor(camera, extractor_options)))
        camera.width, camera.height = width, height


def _factor(camera: pycolmap.Camera, extractor_options: Mapping[str, Any]) -> float:
    return shrink_factor(extractor_options, camera.width, camera.height)


def _set(camera: pycolmap.Camera, other: pycolmap.Camera) -> None:
    camera.params = other.params.tolist()
    camera.width, camera.height = other.width, other.height
