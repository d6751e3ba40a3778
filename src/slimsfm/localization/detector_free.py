"""Matching a query with reference photos as wholes, without keypoints of its own."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from slimsfm.arrays import Descriptors, Ids, Points2D
from slimsfm.errors import InputError
from slimsfm.features import unit_rows
from slimsfm.features.image_matching import EncodedImage, ImageMatcher, Photo, load_image_matcher
from slimsfm.localization.strategy import PointMatches, Query, Target
from slimsfm.mapping.map import Map

_CACHED = 32  # reference photos kept encoded: 45 MB each at 640 x 480
_DESCRIBED = 2048  # cells that tell what a query looks like, at most


class _Reference(NamedTuple):
    """A reference photo and what it sees."""

    encoded: EncodedImage
    keypoints: Points2D  # pixels of the photo, which may be smaller than the image that was mapped
    points: Ids


class DetectorFreeMatching:
    """Matches queries with the reference photos of one map, numbered in order of name.

    A cell of a photo that matches one of the query stands for the keypoints in it that see a point. Each of
    these is then aligned with the query by itself, so that what is found is where the point is seen, not
    where the middle of the cell is.
    """

    def __init__(self, map: Map, matcher: ImageMatcher | None = None) -> None:
        """Prepare for a map.

        Args:
            map: The map.
            matcher: What matches images; if not given, that which the map was built with.

        Raises:
            InputError: The map has no photos, or what the matcher needs is missing.
        """
        if set(map.images) - set(map.photos):
            raise InputError(
                "the map has no photos, which matching without a detector looks at; "
                "build it with `slimsfm build PHOTOS -o MAP --extractor loftr`"
            )
        self._map = map
        self._names = tuple(map.images)
        self._matcher = matcher or load_image_matcher("loftr", map.info.extractor_options)
        self._reference = lru_cache(_CACHED)(self._read)
        self._last: tuple[Photo, EncodedImage] | None = None

    def match(self, query: Query, row: int, strongest: int | None = None) -> PointMatches:  # noqa: ARG002
        """Match a query with an image.

        Raises:
            InputError: Only features of the query are given, not its image.
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
        """What the image sees."""
        name = self._names[row]
        seen = self._map.observations[name]
        return unit_rows(self._map.features[name].descriptors[seen.rows]), seen.points

    def describe(self, query: Query) -> Descriptors:
        """What the query's cells look like, or an even part of them: for comparing whole images.

        Raises:
            InputError: Only features of the query are given, not its image.
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
        """The query's image; the last one is kept, for it is matched with one reference after the other."""
        if query.image is None:
            raise InputError("matching without a detector looks at the query's image, and there is none")
        last = self._last
        if last is None or last[0] is not query.image:
            self._last = last = (query.image, self._matcher.encode(query.image))
        return last[1]


def _found(points2D: Points2D, points: Ids) -> PointMatches:
    return PointMatches(
        keypoints=np.arange(len(points), dtype=np.int64), points=points, references=1, points2D=points2D
    )
