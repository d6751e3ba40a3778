"""Square parts of images that show the object: what networks trained on such pictures look at.

Where the object is, a pose tells, or a reference image that resembles the query: an affine map from the one
to the other takes the object along [1].

References:
    [1] Sun, Wang, Zhang, He, Zhao, Zhang and Zhou, OnePose: One-Shot Object Pose Estimation without CAD
        Models, CVPR 2022.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil
from typing import cast

import cv2
import numpy as np
import pycolmap

from slimsfm.arrays import Image, Points2D
from slimsfm.geometry import Box, project

SIZE = 512
"""Pixels along a side of the pictures that the networks were trained on."""

_LEAST_PX = 16.0  # along the longer side of a region: on less there is nothing to see
_LEAST_MATCHES = 6
_NEAR_PX, _NEAR = 6.0, 6 / 1920  # how far a match may be from where the affine map says; of the longer side
_FINEST = 8  # samples of a pixel of a crop, each way: enough for photos of 4096 pixels


@dataclass(frozen=True, kw_only=True)
class Region:
    """A part of an image, in its pixels."""

    left: float
    """Where it begins."""

    top: float
    """Where it begins."""

    right: float
    """Where it ends."""

    bottom: float
    """Where it ends."""

    @property
    def side(self) -> float:
        """The longer side."""
        return max(self.right - self.left, self.bottom - self.top)

    @property
    def corners(self) -> Points2D:
        """The four corners."""
        return np.array([(x, y) for x in (self.left, self.right) for y in (self.top, self.bottom)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Crop:
    """A square part of an image, shrunk or enlarged."""

    image: Image
    """The square; black where it is beyond the rim of the whole image."""

    left: float
    """Where in the whole image its left side is."""

    top: float
    """Where in the whole image its upper side is."""

    scale: float
    """Pixels of the whole image to one of the crop."""

    def to_image(self, points2D: Points2D) -> Points2D:
        """Where pixels of the crop are in the whole image."""
        return points2D * self.scale + (self.left, self.top)


@dataclass(frozen=True, kw_only=True)
class Sighting:
    """Where a reference image says that the object is."""

    region: Region
    """The part of the query."""

    inliers: int
    """Matches that agree with it."""


def crop_region(image: Image, region: Region, size: int = SIZE) -> Crop:
    """Cut the square around a region out of an image, its centre that of the region, its side the longer one.

    Interpolation is linear. Where the image is shrunk, several samples make a pixel, so that fine texture
    does not turn into a false coarse one.

    Args:
        image: The whole image.
        region: Any region that is not empty.
        size: Pixels along a side of the result.
    """
    side, scale = region.side, region.side / size
    left = (region.left + region.right - side) / 2
    top = (region.top + region.bottom - side) / 2
    samples = min(max(ceil(scale), 1), _FINEST)
    step = scale / samples
    # OpenCV has the centre of the top-left pixel at (0, 0), in the crop as in the image.
    shift = (step - 1) / 2
    image_from_crop = np.array([[step, 0, left + shift], [0, step, top + shift]])
    shape = (samples * size, samples * size)
    fine = cv2.warpAffine(image, image_from_crop, shape, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    square = fine if samples == 1 else cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA)
    return Crop(image=cast(Image, square), left=left, top=top, scale=scale)


def region_of_box(box: Box, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> Region | None:
    """The part of an image that shows a box; None where it is out of sight, or reaches behind the camera."""
    corners = project(box.corners, cam_from_world, camera)
    return _around(corners, (camera.width, camera.height))


def region_by_matches(
    points2D_query: Points2D,
    points2D_reference: Points2D,
    region_in_reference: Region,
    image_size: tuple[int, int],
) -> Sighting | None:
    """Where a query shows what a region of a reference image shows, by matches between the two.

    A turn, a scale and a shift are sought by RANSAC; they take the corners of the region along. O(matches).

    Args:
        points2D_query: Pixels of the query; row i matches row i of `points2D_reference`.
        points2D_reference: Pixels of the reference image.
        region_in_reference: Where the object is in the reference image.
        image_size: Width and height of the query.

    Returns:
        The region, cut off at the rim of the query, or None: fewer than six matches agree, or with something
        out of sight.
    """
    if len(points2D_query) < _LEAST_MATCHES:
        return None
    query_from_reference, inliers = cv2.estimateAffinePartial2D(
        points2D_reference,
        points2D_query,
        method=cv2.RANSAC,
        ransacReprojThreshold=max(_NEAR_PX, _NEAR * max(image_size)),
    )
    if query_from_reference is None or np.count_nonzero(inliers) < _LEAST_MATCHES:
        return None
    corners = np.column_stack([region_in_reference.corners, np.ones(4)]) @ query_from_reference.T
    region = _around(corners, image_size)
    return region and Sighting(region=region, inliers=int(np.count_nonzero(inliers)))


def best_region(sightings: Iterable[Sighting | None]) -> Region | None:
    """The region with which most matches agree, the first of several; None where there is none."""
    found = [one for one in sightings if one is not None]
    return max(found, key=lambda one: one.inliers).region if found else None


def _around(corners: Points2D, image_size: tuple[int, int]) -> Region | None:
    """What contains some pixels, cut off at the rim of the image: beyond it there is nothing to see."""
    if not np.isfinite(corners).all():
        return None
    (left, top), (right, bottom) = (
        np.clip(corner, 0, image_size).tolist() for corner in (corners.min(axis=0), corners.max(axis=0))
    )
    region = Region(left=left, top=top, right=right, bottom=bottom)
    is_empty = left >= right or top >= bottom
    return None if is_empty or region.side < _LEAST_PX else region
