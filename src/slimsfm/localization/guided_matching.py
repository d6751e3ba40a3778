"""Match points of a map near where they project, given an approximate pose."""

from dataclasses import replace
from math import ceil

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.arrays import Image
from slimsfm.features import Extractor, Features, NearestOptions
from slimsfm.geometry import Box, project
from slimsfm.localization.strategy import PointMatches, Query, Target

_MARGIN = 0.25  # of the size of the box in the image, added on each side
_LEAST_PX = 64  # shortest side of a region
_RADIUS = 0.08  # of the longer side of the image: largest distance between a keypoint and a projection
_MAX_RATIO = 0.9  # few candidates are near a projection, so the ratio test may be lenient


def extract_near(
    extractor: Extractor,
    image: Image,
    box: Box,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
) -> Features:
    """Extract features in the part of an image that shows a box and a margin, in pixels of the whole image.

    If the box is out of sight, the part is the one at the edge of the image that is nearest to it.
    """
    rows, columns = _window_of_box(box, cam_from_world, camera)
    found = extractor.extract(np.ascontiguousarray(image[rows, columns]))
    shift = np.array([columns.start, rows.start], np.float32)
    size = (camera.width, camera.height)
    return replace(found, keypoints=found.keypoints + shift, image_size=size)


def _window_of_box(
    box: Box, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera
) -> tuple[slice, slice]:
    """Rows and columns of an image that show a box and a margin."""
    corners = project(box.corners, cam_from_world, camera)
    corners = corners[np.isfinite(corners).all(axis=1)]
    size = np.array([camera.width, camera.height], np.float64)
    low, high = (corners.min(axis=0), corners.max(axis=0)) if len(corners) else (np.zeros(2), size)
    margin = np.maximum(_MARGIN * (high - low), (_LEAST_PX - (high - low)) / 2)
    left, top = np.clip(low - margin, 0, np.maximum(size - _LEAST_PX, 0)).astype(int).tolist()
    right, bottom = np.minimum(np.maximum(high + margin, (left + _LEAST_PX, top + _LEAST_PX)), size).tolist()
    return slice(top, ceil(bottom)), slice(left, ceil(right))


def match_near(
    query: Query,
    target: Target,
    pixels: Float64[np.ndarray, "m 2"],
    camera: pycolmap.Camera,
    matching: NearestOptions = NearestOptions(),
) -> PointMatches:
    """Match descriptors like `match_nearest`, but only those that are near each other in the image.

    Args:
        query: The query.
        target: Descriptors and points to match it with.
        pixels: Projection of each of the target's points.
        camera: The query's intrinsics.
        matching: Gives the largest angle between matched descriptors; its ratio test is not used but a more
            lenient one.
    """
    inside = np.isfinite(pixels).all(axis=1)
    descriptors, points, pixels = target[0][inside], target[1][inside], pixels[inside]
    if not len(query.keypoints) or not len(points):
        return PointMatches.none()
    cosines = query.descriptors @ descriptors.T
    keypoints, places = query.keypoints.astype(np.float32), pixels.astype(np.float32)
    radius = np.float32(_RADIUS * max(camera.width, camera.height))
    for axis in (0, 1):
        cosines[np.abs(keypoints[:, axis, None] - places[None, :, axis]) > radius] = -1
    nearest = cosines.argmax(axis=0)
    columns = np.arange(len(points))
    best = cosines[nearest, columns]
    mutual = cosines.argmax(axis=1)[nearest] == columns
    cosines[nearest, columns] = -1
    angles, seconds = (np.arccos(np.clip(c, -1, 1)) for c in (best, cosines.max(axis=0)))
    good = np.flatnonzero(mutual & (angles <= matching.max_distance) & (angles <= _MAX_RATIO * seconds))
    return _sorted(nearest[good], points[good])


def _sorted(keypoints: Int64[np.ndarray, " k"], points: Int64[np.ndarray, " k"]) -> PointMatches:
    order = np.lexsort([points, keypoints])
    return PointMatches(keypoints=keypoints[order], points=points[order])
