"""The exact pass: match all visible points near where a sure pose projects them, and weigh each match.

A search stops as soon as its pose is sure, with the matches that it has by then. Once the pose is known to a
few pixels, a point competes only with the keypoints around its projection. So points match that look like
others elsewhere, and keypoints that no round has looked at. The pose is then refined over all matches; a
keypoint is the less exact, the larger its scale is.

The evidence stays that of the search, except for how well the matches determine the pose: matches that were
only looked for near the pose always agree with it, also with a wrong one.
"""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64
from scipy.spatial import KDTree

from slimsfm.arrays import Ids, Points2D
from slimsfm.features import NearestOptions
from slimsfm.geometry import project
from slimsfm.localization.point_descriptors import PointSizes
from slimsfm.localization.strategies import ThroughReferences
from slimsfm.localization.strategy import (
    PointMatches,
    PoseGuided,
    Query,
    Strategy,
    Target,
    first_rows,
    some_points,
    unite,
)
from slimsfm.localization.verification import inflation
from slimsfm.mapping.map import Map
from slimsfm.pose import PoseEstimate
from slimsfm.pose.weighted import refine_weighted

_REFERENCES = 3  # images whose points are matched
_CANDIDATES = 8  # nearest keypoints of a projection that are compared with its point
_SAME_PX = 2.0  # keypoints at about the same position do not compete
_MAX_RATIO = 0.7  # of the angles to the best and the second best candidate
_ALIKE = 0.6  # of the largest angle between matching descriptors
_GROWTH = 0.3  # of a keypoint's spread with its scale in pixels
_MOST_POINTS = 1500  # that are matched, so that the pass takes a few milliseconds


@dataclass(frozen=True, kw_only=True, eq=False)
class Exact:
    """A pose that was refined over more matches, and all matches."""

    pose: PoseEstimate
    """The pose; its inliers are rows of `matches`."""

    matches: PointMatches
    """The matches of the search and those near the pose."""


class ExactPass:
    """Makes sure poses in one map exact."""

    def __init__(self, map: Map, strategy: Strategy, sizes: PointSizes) -> None:
        self._points3D_in_world = map.points3D_in_world
        self._metric = map.descriptor_metric
        self._strategy, self._sizes = strategy, sizes

    def refined(
        self,
        query: Query,
        matches: PointMatches,
        pose: PoseEstimate,
        camera: pycolmap.Camera,
        limit_px: float,
    ) -> Exact | None:
        """Match near a pose and refine it.

        Args:
            query: The query, in the pixels in which its features were found.
            matches: The matches of the search.
            pose: The pose that they gave.
            camera: The query's intrinsics in the same pixels.
            limit_px: Largest reprojection error of an inlier.

        Returns:
            The refined pose and its matches. None where the pass does not apply: the strategy finds keypoints
            itself, intrinsics were estimated with the pose, or fewer matches agree than before.
        """
        if matches.points2D is not None or pose.camera is not None or isinstance(self._strategy, PoseGuided):
            return None
        target = self._visible(pose.cam_from_world, matches.points[pose.inliers], camera)
        pixels = project(self._points3D_in_world[target[1]], pose.cam_from_world, camera)
        near = match_around(query, target, pixels, limit_px, self._metric)
        both = replace(unite([matches, near]), references=matches.references)
        found = refine_weighted(
            both.pixels(query),
            self._points3D_in_world[both.points],
            pose.cam_from_world,
            camera,
            spreads(query, both.keypoints),
            max_error_px=limit_px,
        )
        if found.covariance is None or found.num_inliers < pose.num_inliers:
            return None
        kept = replace(
            pose,
            cam_from_world=found.cam_from_world,
            inliers=found.inliers,
            covariance=inflation(pose.estimated) ** 2 * found.covariance,
        )
        return Exact(pose=kept, matches=both)

    def _visible(self, cam_from_world: pycolmap.Rigid3d, agreeing: Ids, camera: pycolmap.Camera) -> Target:
        """The points that should be visible, as several images see them where the strategy knows images."""
        if isinstance(self._strategy, ThroughReferences):
            descriptors, points = self._strategy.references.nearest_points(agreeing, _REFERENCES)
        else:
            descriptors, points = self._strategy.visible_points(cam_from_world, agreeing)
        shown = np.flatnonzero(self._sizes.show(points, cam_from_world, camera))
        shown = shown[some_points(points[shown], _MOST_POINTS)]
        return descriptors[shown], points[shown]


def spreads(query: Query, keypoints: Ids) -> Float64[np.ndarray, " n"]:
    """How much less exact each keypoint is than a small one; 1 where the detector estimates no scale.

    Small keypoints are as exact as the map's points, large ones as their scale allows. Read off the errors of
    right matches on photos and renderings, whole and shrunk.
    """
    frames = query.features.frames
    if frames is None:
        return np.ones(len(keypoints))
    scales_px = frames[keypoints, 0].astype(np.float64) / query.shrink_factor
    return np.sqrt(1 + (_GROWTH * scales_px) ** 2)


def match_around(
    query: Query,
    target: Target,
    pixels: Float64[np.ndarray, "m 2"],
    radius_px: float,
    metric: NearestOptions,
) -> PointMatches:
    """Match points with the keypoints around their projections; a keypoint is matched once.

    Args:
        query: The query.
        target: Descriptors and points to match it with; a point is matched once.
        pixels: Projection of each of the points.
        radius_px: Largest distance of a keypoint from it.
        metric: Gives the largest angle between matching descriptors.
    """
    inside = np.isfinite(pixels).all(axis=1)
    if not len(query.keypoints) or not inside.any():
        return PointMatches.none()
    descriptors, points, pixels = target[0][inside], target[1][inside], pixels[inside]
    starts = first_rows(points)
    points, counts = points[starts], np.diff(starts, append=len(points))
    count = min(_CANDIDATES, len(query.keypoints))
    nearest = KDTree(query.keypoints).query(pixels[starts], k=count, distance_upper_bound=radius_px)
    distances, candidates = (np.reshape(one, (-1, count)) for one in nearest)
    some = np.isfinite(distances[:, 0])
    if not some.any():
        return PointMatches.none()
    candidates, missing = candidates[some], np.isinf(distances[some])
    candidates[missing] = 0
    rows, owners = np.repeat(some, counts), np.repeat(np.arange(some.sum()), counts[some])
    cosines = np.einsum("pkd,pd->pk", query.descriptors[candidates[owners]], descriptors[rows])
    cosines = np.maximum.reduceat(cosines, np.flatnonzero(np.diff(owners, prepend=-1)), axis=0)
    cosines[missing] = -1
    good = _unambiguous(query.keypoints, candidates, cosines, metric)
    best = cosines[good].argmax(axis=1)
    return _once(candidates[good, best], points[some][good], cosines[good, best])


def _unambiguous(
    keypoints: Points2D,
    candidates: Int64[np.ndarray, "m k"],
    cosines: Float32[np.ndarray, "m k"],
    metric: NearestOptions,
) -> Int64[np.ndarray, " good"]:
    """Rows whose best candidate is similar, and much more so than any that lies elsewhere."""
    rows = np.arange(len(candidates))
    best = cosines.argmax(axis=1)
    shifts = keypoints[candidates] - keypoints[candidates[rows, best]][:, None]
    elsewhere = np.einsum("pki,pki->pk", shifts, shifts) > _SAME_PX**2
    rivals = np.where(elsewhere, cosines, -1).max(axis=1)
    angles, others = (np.arccos(np.clip(one, -1, 1)) for one in (cosines[rows, best], rivals))
    return np.flatnonzero((angles <= _ALIKE * metric.max_distance) & (angles < _MAX_RATIO * others))


def _once(keypoints: Ids, points: Ids, cosines: Float32[np.ndarray, " n"]) -> PointMatches:
    """Of the matches of each point, then of each keypoint, the most similar one."""
    order = np.argsort(-cosines, kind="stable")
    for ids in (points, keypoints):
        order = order[np.sort(np.unique(ids[order], return_index=True)[1])]
    return PointMatches(keypoints=keypoints[order], points=points[order])
