"""Describe the points of a map: appearances, viewing direction, and whether other points look alike."""

from dataclasses import replace

import numpy as np
import pycolmap
from jaxtyping import Float32

from slimsfm.arrays import Descriptors, Ids, Mask
from slimsfm.features import unit_rows
from slimsfm.features.nearest import learn_words, nearest_word
from slimsfm.localization.appearances import descriptor_sums, find_appearances
from slimsfm.mapping.map import Map, PointDescriptors

_ALIKE = 0.5  # of the largest angle between matching descriptors: points look alike
_LEAST_SCALE_PX = 1.2  # of a keypoint that detectors find reliably
_FAR = 0.1  # of the diagonal: confusing a point with a nearer one hardly harms a pose


def describe_points(map: Map) -> PointDescriptors:
    """Describe all points, including which of them look like no other point of the map."""
    described = describe_appearances(map)
    return replace(described, distinct=_distinct(map, unit_rows(descriptor_sums(map)))[described.points])


def describe_appearances(map: Map) -> PointDescriptors:
    """Describe all points by their appearances and by directions.

    An appearance is the normalized mean of the descriptors of observations that look alike, see
    `find_appearances`.
    """
    found, sizes = find_appearances(map), _sizes(map)
    return PointDescriptors(
        points=found.points,
        descriptors=unit_rows(found.sums),
        directions=_directions(map)[found.points],
        sizes=None if sizes is None else sizes[found.points],
    )


def distinct_points(map: Map) -> Mask:
    """Which points look like no other point of the map that is not near them, as stored or computed."""
    stored = map.point_descriptors
    if stored is None:
        return _distinct(map, unit_rows(descriptor_sums(map)))
    distinct = np.ones(len(map.point3D_ids), dtype=bool)
    if stored.distinct is not None:
        distinct[stored.points] = stored.distinct
    return distinct


def viewing_directions(map: Map) -> Float32[np.ndarray, "points 3"]:
    """The stored viewing direction of each point, else the mean over the images that observe it.

    Zeros where neither is known.
    """
    described = map.point_descriptors
    if map.features or described is None or described.directions is None:
        return _directions(map)
    directions = np.zeros((len(map.point3D_ids), 3), np.float32)
    directions[described.points] = described.directions
    return directions


class PointSizes:
    """Tells how large the points of a map appear in an image: too small ones are not found there."""

    def __init__(self, map: Map) -> None:
        self._points3D_in_world = map.points3D_in_world
        self._sizes = point_sizes(map)

    def show(self, points: Ids, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> Mask:
        """Which of some points a detector finds in an image; all of them if sizes are not known.

        Args:
            points: Rows of the map's points.
            cam_from_world: Pose of the image.
            camera: Its intrinsics, in the pixels in which features are found.
        """
        if self._sizes is None:
            return np.ones(len(points), bool)
        depths = (cam_from_world * self._points3D_in_world[points])[:, 2]
        return camera.mean_focal_length() * self._sizes[points] >= _LEAST_SCALE_PX * depths


def point_sizes(map: Map) -> Float32[np.ndarray, " points"] | None:
    """The stored size of each point's pattern, else the mean over its observations; None if unknown.

    Infinite for single points that it is not known of.
    """
    described = map.point_descriptors
    if map.features or described is None or described.sizes is None:
        return _sizes(map)
    sizes = np.full(len(map.point3D_ids), np.inf, np.float32)
    sizes[described.points] = described.sizes
    return sizes


def _sizes(map: Map) -> Float32[np.ndarray, " points"] | None:
    """Geometric mean of the sizes of the patterns that each point's keypoints describe."""
    sums, counts = np.zeros(len(map.point3D_ids)), np.zeros(len(map.point3D_ids))
    for name, seen in map.observations.items():
        frames = map.features[name].frames if name in map.features else None
        if frames is None:
            return None
        depths = (map.images[name].cam_from_world() * map.points3D_in_world[seen.points])[:, 2]
        sizes = frames[seen.rows, 0] * depths / map.camera(name).mean_focal_length()
        np.add.at(sums, seen.points, np.log(np.maximum(sizes, np.finfo(np.float32).tiny)))
        np.add.at(counts, seen.points, 1)
    known = np.exp(sums / np.maximum(counts, 1)).astype(np.float32)
    return np.where(counts > 0, known, np.float32(np.inf))


def _directions(map: Map) -> Float32[np.ndarray, "points 3"]:
    """Mean of the unit vectors from each point towards the cameras that observe it."""
    sums = np.zeros((len(map.point3D_ids), 3))
    counts = np.zeros(len(sums))
    for name, seen in map.observations.items():
        towards = map.images[name].projection_center() - map.points3D_in_world[seen.points]
        lengths = np.linalg.norm(towards, axis=1, keepdims=True)
        np.add.at(sums, seen.points, towards / np.maximum(lengths, np.finfo(np.float64).tiny))
        np.add.at(counts, seen.points, 1)
    return (sums / np.maximum(counts, 1)[:, None]).astype(np.float32)


def _distinct(map: Map, descriptors: Descriptors) -> Mask:
    """Which points look like no other point of the map that is not near them.

    Points are only compared with those of the same visual word, which points that look alike mostly share.
    O(points^2 / words).
    """
    points, far = map.points3D_in_world, _FAR * map.box.diagonal
    if not len(points):
        return np.zeros(0, dtype=bool)
    alike_at = np.cos(_ALIKE * map.descriptor_metric.max_distance)
    words = map.global_descriptors.vocabulary if map.global_descriptors else learn_words(descriptors)
    word_of = nearest_word(descriptors, words)
    distinct = np.ones(len(points), dtype=bool)
    for word in range(len(words)):
        members = np.flatnonzero(word_of == word)
        alike = descriptors[members] @ descriptors[members].T > np.float32(alike_at)
        rows, columns = (members[side] for side in np.nonzero(np.triu(alike, k=1)))
        apart = np.linalg.norm(points[rows] - points[columns], axis=1) > far
        distinct[rows[apart]] = distinct[columns[apart]] = False
    return distinct
