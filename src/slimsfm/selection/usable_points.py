"""Leaving images out of a map, and which images can use which points.

An image can use a point if a query that looks like the image would match it correctly. This is tested: the
image's own descriptors are removed from the points it sees, its keypoints are matched against the points near
it, and matches with a small reprojection error count. A point with a weak or ambiguous descriptor, or one
that no second image describes, is not usable.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64
from scipy.sparse import csr_array

from slimsfm.arrays import Descriptors, Ids, Points2D
from slimsfm.features import unit_rows
from slimsfm.geometry import motions, reprojection_errors
from slimsfm.localization.appearances import find_appearances
from slimsfm.localization.extraction import SMALLEST_SCALE_PX, first_size
from slimsfm.localization.matching import match_target
from slimsfm.localization.strategy import Target
from slimsfm.mapping.map import Map, observed
from slimsfm.pose import projection_jacobian
from slimsfm.progress import ProgressBar, silent
from slimsfm.selection.problem import SelectionProblem, Twists

_CACHED = 64  # images whose descriptors are cached
_NOTHING_LEFT = 1e-3  # a sum of descriptors shorter than this is empty up to rounding errors


@dataclass(frozen=True, kw_only=True, eq=False)
class LeftOutImage:
    """An image that is left out of the map and serves as a query."""

    keypoints: Points2D
    """Pixels of its keypoints."""

    descriptors: Descriptors
    """Unit descriptor of each keypoint."""

    scales: Float64[np.ndarray, " n"] | None
    """Scale of each keypoint in pixels; None if the map's extractor has no scales."""


class LeftOut:
    """Describes points by their observations in all images but one, so that this one can be a query."""

    def __init__(self, map: Map) -> None:
        self._map = map
        self._found = find_appearances(map)
        self._firsts = np.flatnonzero(np.diff(self._found.points, prepend=-1))
        self._counts = np.diff(self._firsts, append=len(self._found.points))
        self.query = lru_cache(maxsize=_CACHED)(self._query)

    def _query(self, name: str) -> LeftOutImage:
        features = self._map.features[name]
        return LeftOutImage(
            keypoints=features.keypoints.astype(np.float64),
            descriptors=unit_rows(features.descriptors),
            scales=None if features.frames is None else features.frames[:, 0].astype(np.float64),
        )

    def describe(self, points: Ids, name: str) -> Target:
        """The appearances of points without the image's observations; none of points that no other sees.

        Args:
            points: Rows of the map's points, ascending.
            name: The image that is left out.
        """
        counts = self._counts[points]
        ends = np.cumsum(counts)
        rows = np.repeat(self._firsts[points] - ends + counts, counts) + np.arange(counts.sum())
        sums, own = self._found.sums[rows], self._found.of_observations[name]
        place = np.searchsorted(rows, own).clip(max=len(rows) - 1)
        seen = rows[place] == own
        seen_rows = self._map.observations[name].rows[seen]
        np.subtract.at(sums, place[seen], self.query(name).descriptors[seen_rows])
        lengths = np.linalg.norm(sums, axis=1)
        left = lengths > _NOTHING_LEFT
        return sums[left] / lengths[left, None], self._found.points[rows[left]]


_MAX_ERROR_PX = 4.0  # of a correct match
_NEIGHBORS = 20  # other images whose points are matched: those with the most common points


def selection_problem(map: Map, left_out: LeftOut, progress: ProgressBar = silent) -> SelectionProblem:
    """Find which points each reference image can use, and which of them the image can use after shrinking.

    Each image counts twice if keypoints have a scale and the extractor an image size: as it is, and as small
    as the first image that features of a query are extracted from (`localization.extraction`).

    Notes:
        Time is linear in the images: each is matched against the points of at most 20 others.
    """
    near = _points_near(map)
    names = list(map.images)
    uses = [
        _usable(map, left_out, name, points)
        for name, points in zip(progress(names, "find usable points"), near, strict=True)
    ]
    small = [_small(map, name, one) for name, one in zip(names, uses, strict=True)]
    names += [name for name, one in zip(names, small, strict=True) if one]
    uses += [one for one in small if one]
    columns = np.concatenate([one.points for one in uses])
    starts = np.concatenate([[0], np.cumsum([len(one.points) for one in uses])])
    return SelectionProblem(
        usable=csr_array(
            (np.ones(len(columns), bool), columns, starts), shape=(len(names), len(map.point3D_ids))
        ),
        twists=np.concatenate([_twists(map, name, one) for name, one in zip(names, uses, strict=True)]),
        corner_twists=np.stack([_corner_twists(map, name) for name in names]),
    )


def _points_near(map: Map) -> list[Ids]:
    """For each image the points, ascending, that it or its neighbors observe."""
    sees = observed(map)
    common = csr_array(sees.astype(np.int32) @ sees.T.astype(np.int32))
    near = []
    for row in range(len(map.images)):
        others = slice(common.indptr[row], common.indptr[row + 1])
        best = np.argsort(np.negative(common.data[others]), kind="stable")
        images = common.indices[others][best][: _NEIGHBORS + 1]  # itself among them
        near.append(np.unique(sees[images].indices).astype(np.int64))
    return near


class _Uses(NamedTuple):
    """Points that an image can use, ascending."""

    points: Ids
    scales: Float64[np.ndarray, " n"] | None  # of its keypoints, in pixels
    shrink_factor: float  # pixels of the image per pixel in which keypoints are found


def _usable(map: Map, left_out: LeftOut, name: str, points: Ids) -> _Uses:
    query, factor = left_out.query(name), map.shrink_factor(name)
    matches = match_target(query.descriptors, left_out.describe(points, name), map.descriptor_metric)
    matched = matches.points
    errors = reprojection_errors(
        query.keypoints[matches.keypoints],
        map.points3D_in_world[matched],
        map.images[name].cam_from_world(),
        map.camera(name),
    )
    good = np.flatnonzero(errors <= _MAX_ERROR_PX * factor)
    good = good[np.argsort(matched[good], kind="stable")]
    scales = None if query.scales is None else query.scales[matches.keypoints[good]]
    return _Uses(matched[good], scales, factor)


def _small(map: Map, name: str, uses: _Uses) -> _Uses | None:
    """Those that the image can use when it is shrunk; None without scales or an image size."""
    largest = map.info.extractor_options.get("max_image_size")
    if uses.scales is None or not largest:
        return None
    camera = map.camera(name)
    longer = max(camera.width, camera.height)
    factor = longer / first_size(min(longer, largest))
    found = uses.scales >= SMALLEST_SCALE_PX * factor
    return _Uses(uses.points[found], uses.scales[found], factor)


def _twists(map: Map, name: str, uses: _Uses) -> Twists:
    """Twists of an ideal pinhole camera: lens distortion hardly changes the information of a match."""
    in_cam = map.images[name].cam_from_world() * map.points3D_in_world[uses.points]
    focal_px = map.camera(name).mean_focal_length() / uses.shrink_factor
    twists = projection_jacobian(in_cam, focal_px)
    return (twists * _in_diagonals(map.box.diagonal)).astype(np.float32)


def _corner_twists(map: Map, name: str) -> Float32[np.ndarray, "24 6"]:
    in_cam = map.images[name].cam_from_world() * map.box.corners
    twists = motions(in_cam) * _in_diagonals(map.box.diagonal)
    return (twists / map.box.diagonal).reshape(24, 6).astype(np.float32)


def _in_diagonals(diagonal: float) -> Float64[np.ndarray, "6"]:
    """Factors that turn a derivative by shifts in map units into one by shifts in diagonals."""
    return np.array([1, 1, 1, diagonal, diagonal, diagonal])
