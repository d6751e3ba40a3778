"""Matching a query with reference photos as a whole, without keypoints of the query."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from slimsfm.arrays import Descriptors, Ids, Points2D
from slimsfm.errors import InputError
from slimsfm.features import unit_rows
from slimsfm.localization.strategy import PointMatches, Query, Target
from slimsfm.mapping.map import Map
from slimsfm.methods.loftr.image_matching import EncodedImage, ImageMatcher, Photo

_CACHED = 32  # encoded reference photos kept in memory: 45 MB each at 640 x 480
_DESCRIBED = 2048  # most cells that describe a whole query


class _Reference(NamedTuple):
    """An encoded reference photo and its observations."""

    encoded: EncodedImage
    keypoints: Points2D  # pixels of the photo, which may be smaller than the image that was mapped
    points: Ids


class DetectorFreeMatching:
    """Matches queries with the reference photos of one map, numbered in order of name.

    When a cell of a photo matches a cell of the query, each keypoint in it that observes a point is aligned
    with the query separately. The result is the pixel where the point is seen, not the center of the cell.
    """

    def __init__(self, map: Map, load_matcher: Callable[[], ImageMatcher]) -> None:
        """Prepare matching.

        Args:
            map: A map with photos.
            load_matcher: Loads the matcher with which the map was built.

        Raises:
            InputError: The map has no photos, or a package that the matcher needs is missing.
        """
        if set(map.images) - set(map.photos):
            raise InputError(
                "the map has no photos, which matching without a detector needs; "
                f"build it with the extractor {map.info.extractor}"
            )
        self._map = map
        self._names = tuple(map.images)
        self._matcher = load_matcher()
        self._reference = lru_cache(_CACHED)(self._read)
        self._last: tuple[Photo, EncodedImage] | None = None

    def match(self, query: Query, row: int, strongest: int | None = None) -> PointMatches:  # noqa: ARG002
        """Match a query with a reference photo.

        Raises:
            InputError: The query has no image.
        """
        seen, reference = self._encoded(query), self._reference(row)
        cells = self._matcher.match_cells(reference.encoded, seen)
        if not len(cells) or not len(reference.points):
            return _found(np.zeros((0, 2)), reference.points[:0])
        half = reference.encoded.cell_px / 2
        distances, nearest = KDTree(cells.points2D_1).query(
            reference.keypoints, p=np.inf, distance_upper_bound=np.nextafter(half, np.inf)
        )
        rows = np.flatnonzero(np.isfinite(distances))
        keypoints, cell = reference.keypoints[rows], np.asarray(nearest)[rows]
        off = (keypoints - cells.points2D_1[cell]) * (seen.cell_px / reference.encoded.cell_px)
        exact = self._matcher.align(reference.encoded, seen, keypoints, cells.points2D_2[cell] + off)
        return _found(exact * (query.camera.width / seen.image_size[0]), reference.points[rows])

    def target(self, row: int) -> Target:
        """Descriptors of the observations of a reference image, and their points."""
        name = self._names[row]
        seen = self._map.observations[name]
        return unit_rows(self._map.features[name].descriptors[seen.rows]), seen.points

    def describe(self, query: Query) -> Descriptors:
        """Describe the cells of a query, or an evenly spaced part of them, for image retrieval.

        Raises:
            InputError: The query has no image.
        """
        seen = self._encoded(query)
        sides = (np.arange(seen.cell_px / 2, side, seen.cell_px) for side in seen.image_size)
        cells = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
        return unit_rows(self._matcher.describe(seen, cells[:: -(-len(cells) // _DESCRIBED)]))

    def _read(self, row: int) -> _Reference:
        name = self._names[row]
        seen, encoded = self._map.observations[name], self._matcher.encode(self._map.photos[name])
        keypoints = self._map.features[name].keypoints[seen.rows].astype(np.float64)
        shrinking = np.array(encoded.image_size) / (
            self._map.camera(name).width,
            self._map.camera(name).height,
        )
        return _Reference(encoded=encoded, keypoints=keypoints * shrinking, points=seen.points)

    def _encoded(self, query: Query) -> EncodedImage:
        """Encode the query. The last one is kept, because it is matched with several references in turn."""
        if query.image is None:
            raise InputError(
                "matching without a detector needs the query's image, but only its features are given"
            )
        last = self._last
        if last is None or last[0] is not query.image:
            self._last = last = (query.image, self._matcher.encode(query.image))
        return last[1]


def _found(points2D: Points2D, points: Ids) -> PointMatches:
    return PointMatches(
        keypoints=np.arange(len(points), dtype=np.int64), points=points, references=1, points2D=points2D
    )
