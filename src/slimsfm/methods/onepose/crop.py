"""Square crops of images that show the object, as the networks of OnePose and OnePose++ were trained on.

The object is located by a pose, or by reference images that resemble the query: a similarity transform from
the reference to the query maps the object's region along [1].

References:
    [1] Sun, Wang, Zhang, He, Zhao, Zhang and Zhou, OnePose: One-Shot Object Pose Estimation without CAD
        Models, CVPR 2022.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil
from typing import NamedTuple, cast

import cv2
import numpy as np
import pycolmap

from slimsfm.arrays import Ids, Image, Points2D
from slimsfm.geometry import Box, project
from slimsfm.localization.strategy import PointMatches

CROP_PX = 512
"""Side in pixels of the crops on which the networks were trained."""

_LEAST_PX = 16.0  # longer side of a region; smaller ones show too little
_LEAST_MATCHES = 6
_NEAR_PX, _NEAR = 6.0, 6 / 1920  # largest error of an inlier: in pixels, and relative to the longer side
_FINEST = 8  # samples per pixel of a crop and axis: enough for photos of 4096 pixels
LOOKED_AT = 15
"""Reference images that are matched to locate the object, as in OnePose."""

_SURE = 60  # inliers with which no further image is matched


@dataclass(frozen=True, kw_only=True)
class Region:
    """A rectangle in an image, in pixels."""

    left: float
    """Smallest x."""

    top: float
    """Smallest y."""

    right: float
    """Largest x."""

    bottom: float
    """Largest y."""

    @property
    def side(self) -> float:
        """Length of the longer side."""
        return max(self.right - self.left, self.bottom - self.top)

    @property
    def corners(self) -> Points2D:
        """The four corners."""
        return np.array([(x, y) for x in (self.left, self.right) for y in (self.top, self.bottom)])

    def scaled(self, across: float | int, down: float | int) -> "Region":
        """Multiply x and y by a factor each."""
        return Region(
            left=across * self.left,
            top=down * self.top,
            right=across * self.right,
            bottom=down * self.bottom,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Crop:
    """A square part of an image, resized."""

    image: Image
    """The square; black beyond the border of the whole image."""

    left: float
    """Left side of the square in the whole image, in pixels."""

    top: float
    """Upper side of the square in the whole image, in pixels."""

    scale: float
    """Pixels of the whole image per pixel of the crop."""

    def to_image(self, points2D: Points2D) -> Points2D:
        """Convert pixels of the crop to pixels of the whole image."""
        return points2D * self.scale + (self.left, self.top)


@dataclass(frozen=True, kw_only=True)
class RegionVote:
    """The region of the object in a query according to one reference image."""

    region: Region
    """Region of the query."""

    inliers: int
    """Matches that agree with it."""


class LocatedObject(NamedTuple):
    """The region of the object in a query according to several reference images."""

    region: Region | None
    """Region of the query; None if no reference image locates the object."""

    references: int
    """Reference images that were matched."""


class FoundPoints(NamedTuple):
    """Points found in a query; each occurs once."""

    points: Ids
    """Rows of the map's points."""

    points2D: Points2D
    """Pixels of each point."""

    def added_to(self, before: "FoundPoints") -> "FoundPoints":
        """Add earlier results for points that are not among these."""
        rest = ~np.isin(before.points, self.points)
        parts = zip(self, (column[rest] for column in before), strict=True)
        return FoundPoints(*(np.concatenate(part) for part in parts))

    def matches(self, references: int = 0, pixel: float = np.inf) -> PointMatches:
        """Convert to matches, each with its own keypoint.

        Args:
            references: Number of reference images that were matched.
            pixel: Side of a pixel of the crop that they were found in, in pixels of the query.
        """
        return PointMatches(
            keypoints=np.arange(len(self.points), dtype=np.int64),
            points=self.points,
            references=references,
            points2D=self.points2D,
            shrink_factor=pixel,
        )


def crop_region(image: Image, region: Region, size: int = CROP_PX) -> Crop:
    """Crop the square that has the center and the longer side of a region.

    Interpolation is linear. If the image is shrunk, each pixel averages several samples to avoid aliasing.

    Args:
        image: The whole image.
        region: A region that is not empty.
        size: Side of the result in pixels.
    """
    side, scale = region.side, region.side / size
    left = (region.left + region.right - side) / 2
    top = (region.top + region.bottom - side) / 2
    samples = min(max(ceil(scale), 1), _FINEST)
    step = scale / samples
    # OpenCV puts the center of the top-left pixel at (0, 0), in the crop as in the image.
    shift = (step - 1) / 2
    image_from_crop = np.array([[step, 0, left + shift], [0, step, top + shift]])
    shape = (samples * size, samples * size)
    fine = cv2.warpAffine(image, image_from_crop, shape, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    square = fine if samples == 1 else cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA)
    return Crop(image=cast(Image, square), left=left, top=top, scale=scale)


def box_region(box: Box, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> Region | None:
    """The region of an image that shows a box; None if it is out of sight or reaches behind the camera."""
    corners = project(box.corners, cam_from_world, camera)
    return _around(corners, (camera.width, camera.height))


def region_by_matches(
    points2D_query: Points2D,
    points2D_reference: Points2D,
    region_in_reference: Region,
    image_size: tuple[int, int],
) -> RegionVote | None:
    """Locate in a query what a region of a reference image shows, by matches between the two.

    RANSAC estimates a rotation, a scale and a shift, which map the corners of the region. O(matches).

    Args:
        points2D_query: Pixels of the query; row i matches row i of `points2D_reference`.
        points2D_reference: Pixels of the reference image.
        region_in_reference: Region of the object in the reference image.
        image_size: Width and height of the query.

    Returns:
        The region, clipped to the query, or None if fewer than six matches agree or the region is out of
        sight.
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
    return region and RegionVote(region=region, inliers=int(np.count_nonzero(inliers)))


def locate_object(votes: Iterable[RegionVote | None]) -> LocatedObject:
    """Take the region with the most inliers, the first of equals; stop early at 60 inliers."""
    seen: list[RegionVote | None] = []
    for vote in votes:
        seen.append(vote)
        if vote is not None and vote.inliers >= _SURE:
            break
    found = [one for one in seen if one is not None]
    best = max(found, key=lambda one: one.inliers).region if found else None
    return LocatedObject(best, len(seen))


def _around(corners: Points2D, image_size: tuple[int, int]) -> Region | None:
    """The bounding rectangle of some pixels, clipped to the image."""
    if not np.isfinite(corners).all():
        return None
    (left, top), (right, bottom) = (
        np.clip(corner, 0, image_size).tolist() for corner in (corners.min(axis=0), corners.max(axis=0))
    )
    region = Region(left=left, top=top, right=right, bottom=bottom)
    is_empty = left >= right or top >= bottom
    return None if is_empty or region.side < _LEAST_PX else region
