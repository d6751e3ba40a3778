"""A frame as the tracker sees it: grey, and no larger than it needs to be."""

from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap

from slimsfm.arrays import GrayImage, Image


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A frame in grey."""

    gray: GrayImage
    """The picture."""

    camera: pycolmap.Camera
    """Its intrinsics."""

    scale: float
    """Its width over that of the frame."""


def view_of(image: Image, camera: pycolmap.Camera, max_size_px: int) -> View:
    """Turn a frame grey, and shrink it if its longer side has more pixels than this."""
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    height, width = gray.shape
    if max(height, width) <= max_size_px:
        return View(gray=gray, camera=camera, scale=1.0)
    factor = max_size_px / max(height, width)
    small_size = max(1, round(width * factor)), max(1, round(height * factor))
    small_camera = pycolmap.Camera(camera.todict())
    small_camera.rescale(*small_size)
    small = np.asarray(cv2.resize(gray, small_size, interpolation=cv2.INTER_AREA), np.uint8)
    return View(gray=small, camera=small_camera, scale=small_size[0] / width)
