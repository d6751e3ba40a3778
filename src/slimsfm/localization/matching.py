"""Match a query with one reference image, or with points near where they project."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from math import ceil
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64

from slimsfm.arrays import Descriptors, Image
from slimsfm.errors import InputError
from slimsfm.features import (
    Extractor,
    Features,
    Matcher,
    NearestOptions,
    load_matcher,
    match_many,
    match_nearest,
    shrink_factor,
    unit_rows,
)
from slimsfm.geometry import Box, project
from slimsfm.localization.strategy import MatchingOptions, PointMatches, Query, Target, first_rows
from slimsfm.mapping.extractor import extractor_of
from slimsfm.mapping.map import Map


@runtime_checkable
class ReferenceMatching(Protocol):
    """Matches queries with the reference images of one map, which are numbered in order of name."""

    def match(self, pairs: Sequence[tuple[Query, int]], strongest: int | None) -> list[PointMatches]:
        """Match queries with images.

        Args:
            pairs: A query and an image each; all that are known together, because a network matches several
                pairs at once sooner than one after the other.
            strongest: Match only this many of a query's strongest keypoints, if the matcher matches
                keypoints one by one; None for all.
        """
        ...

    def target(self, row: int) -> Target:
        """Descriptors and points that the image sees."""
        ...

    def describe(self, query: Query) -> Descriptors:
        """Local descriptors of a query, of the kind that the images' global descriptors are made from.

        Only the first 2048 rows are used.
        """
        ...


@runtime_checkable
class WholeImageExtractor(Protocol):
    """An extractor without keypoints, which provides its own way to match a query with reference images."""

    def reference_matching(self, map: Map) -> ReferenceMatching:
        """Prepare matching for a map that this extractor built."""
        ...


def matching_with(map: Map, options: MatchingOptions, cached: int | None = None) -> ReferenceMatching:
    """Create the matching that the options ask for.

    Args:
        map: The map.
        options: Which matcher.
        cached: Number of images whose descriptors stay in memory; None for all.

    Raises:
        InputError: The matcher is unknown, or cannot match features of the map's kind.
    """
    extractor = map.info.extractor
    if not map.has_keypoints and options.matcher in ("auto", extractor):
        made = extractor_of(map)
        if isinstance(made, WholeImageExtractor):
            return made.reference_matching(map)
        raise InputError(f"extractor {extractor!r} finds no keypoints and has no `reference_matching`")
    if options.matcher in ("auto", "nearest"):
        return NearestMatching(map, map.descriptor_metric, cached)
    return PairMatching(map, load_matcher(options.matcher, extractor), cached)


class NearestMatching:
    """Matches descriptors by their distance, only with keypoints that see a point of the map.

    Matches with other keypoints do not contribute to the pose.
    """

    def __init__(self, map: Map, options: NearestOptions, cached: int | None) -> None:
        self._options = options
        names = list(map.images)
        self._target = lru_cache(cached)(lambda row: reference_target(map, names[row]))
        for row in range(len(names) if cached is None else 0):
            self._target(row)  # read now, not for the first query

    def match(self, pairs: Sequence[tuple[Query, int]], strongest: int | None) -> list[PointMatches]:
        """Match the queries' descriptors with those of images."""
        return [
            match_target(query.descriptors[:strongest], self._target(row), self._options, references=1)
            for query, row in pairs
        ]

    def target(self, row: int) -> Target:
        """Descriptors and points that the image sees."""
        return self._target(row)

    def describe(self, query: Query) -> Descriptors:
        """The query's own descriptors."""
        return query.descriptors


class PairMatching:
    """Matches features by a network that sees those of both images; only keypoints that see a point."""

    def __init__(self, map: Map, matcher: Matcher, cached: int | None) -> None:
        self._matcher = matcher
        self._points = [seen.points for seen in map.observations.values()]
        names = list(map.images)
        self._seeing = lru_cache(cached)(lambda row: _seeing(map, names[row]))
        for row in range(len(names) if cached is None else 0):
            self._seeing(row)  # read now, not for the first query

    def match(self, pairs: Sequence[tuple[Query, int]], strongest: int | None) -> list[PointMatches]:  # noqa: ARG002
        """Match all of the queries' features with those of images."""
        found = match_many(self._matcher, [(query.features, self._seeing(row)) for query, row in pairs])
        return [
            PointMatches(keypoints=one[:, 0], points=self._points[row][one[:, 1]], references=1)
            for one, (_, row) in zip(found, pairs, strict=True)
        ]

    def target(self, row: int) -> Target:
        """Descriptors and points that the image sees."""
        return unit_rows(self._seeing(row).descriptors), self._points[row]

    def describe(self, query: Query) -> Descriptors:
        """The query's own descriptors."""
        return query.descriptors


def _seeing(map: Map, name: str) -> Features:
    return map.features[name][map.observations[name].rows]


def reference_target(map: Map, name: str) -> Target:
    """Descriptors and points that a reference image sees."""
    return unit_rows(_seeing(map, name).descriptors), map.observations[name].points


def match_target(
    descriptors: Descriptors, target: Target, options: NearestOptions, references: int = 0
) -> PointMatches:
    """Match descriptors of a query with those of a target by nearest neighbors.

    A point is matched by its best appearance, and competes with other points only.
    """
    target_descriptors, points = target
    pairs = match_nearest(descriptors, target_descriptors, options, firsts=first_rows(points))
    return PointMatches(keypoints=pairs[:, 0], points=points[pairs[:, 1]], references=references)


class BestCosines(NamedTuple):
    """How similar descriptors are to points, each by its best appearance."""

    cosines: Float32[np.ndarray, "n points"]
    firsts: Int64[np.ndarray, " points"]
    """The first row of each point in the target."""


def best_cosines(descriptors: Descriptors, target: Target) -> BestCosines:
    """Compare descriptors with the points of a target that has at least one."""
    firsts = first_rows(target[1])
    if len(firsts) == len(target[1]):
        return BestCosines(descriptors @ target[0].T, firsts)
    return BestCosines(np.maximum.reduceat(target[0] @ descriptors.T, firsts, axis=0).T, firsts)


_MARGIN = 0.25  # of the size of the box in the image, added on each side
_LEAST_PX = 64  # shortest side of a region
_RADIUS = 0.08  # of the longer side of the image: largest distance between a keypoint and a projection
_MAX_RATIO = 0.9  # few candidates are near a projection, so the ratio test may be lenient


class NearFeatures(NamedTuple):
    """Features of a part of an image."""

    features: Features
    """In pixels of the whole image."""

    shrink_factor: float
    """Pixels of the image per pixel in which they were found."""


def extract_near(
    extractor: Extractor,
    image: Image,
    box: Box,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
) -> NearFeatures:
    """Extract features in the part of an image that shows a box and a margin, in pixels of the whole image.

    If the box is out of sight, the part is the one at the edge of the image that is nearest to it.
    """
    rows, columns = _window_of_box(box, cam_from_world, camera)
    found = extractor.extract(np.ascontiguousarray(image[rows, columns]))
    shift = np.array([columns.start, rows.start], np.float32)
    size = (camera.width, camera.height)
    return NearFeatures(
        features=replace(found, keypoints=found.keypoints + shift, image_size=size),
        shrink_factor=shrink_factor(extractor.options, *found.image_size),
    )


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
    """Match descriptors like `match_target`, but only those that are near each other in the image.

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
    cosines, firsts = best_cosines(query.descriptors, (descriptors, points))
    points, pixels = points[firsts], pixels[firsts]
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
