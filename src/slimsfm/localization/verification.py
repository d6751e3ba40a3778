"""Collect the evidence for a pose, from which its confidence is computed: see `evidence`."""

from dataclasses import replace

import numpy as np
import pycolmap
from jaxtyping import Bool

from slimsfm.arrays import Ids, Mask, Points2D
from slimsfm.geometry import ADD_FRACTIONS, corner_error, project
from slimsfm.localization.evidence import RIVAL_RANSAC, Evidence
from slimsfm.localization.matching import best_cosines
from slimsfm.localization.point_descriptors import PointSizes, viewing_directions
from slimsfm.localization.strategy import PointMatches, Query, Strategy, Target, some_points
from slimsfm.mapping.map import Map
from slimsfm.pose import PoseEstimate, estimate_pose
from slimsfm.pose.camera_fit import misfit

_DETERMINED = 0.02  # predicted error up to which one of 0.1 would be five standard deviations
_ONE_SIDED = 0.3  # length of a point's mean viewing direction from which it has a side
_CELLS = 16  # squares along the longer side of the image
_NEAREST = 3  # images that are next to a pose
_CHECKED = 100  # visible points to look for
_STRONGEST = 2048  # keypoints to look among
_NEAR_PX, _FAR_PX = 5.0, 15.0  # distance from the projection of a point: at most there, at least elsewhere
_MAX_RATIO = 0.9  # angle to the descriptor there over angle to the best one elsewhere

_INFLATION = 1.2, 2.5, 3.5


def inflation(estimated: tuple[str, ...]) -> float:
    """Factor of the standard deviations of a pose with no, one, and two intrinsics estimated.

    Errors of neighboring points are alike, which matters the more, the finer the differences are that tell
    the intrinsics from the pose. Measured by `benchmarks/confidence.py`: bounds hold in 95 % of cases.
    """
    return _INFLATION[min(len(estimated), len(_INFLATION) - 1)]


class Verifier:
    """Collects the evidence for poses in one map."""

    def __init__(self, map: Map, strategy: Strategy, distinct: Mask, sizes: PointSizes) -> None:
        """Prepare for a map.

        Args:
            map: The map.
            strategy: The strategy whose matches are verified.
            distinct: Which points of the map look like no other, by `distinct_points`.
            sizes: How large its points appear.
        """
        self._extractor = map.info.extractor
        self._points3D_in_world = map.points3D_in_world
        self._box = map.box
        self._strategy = strategy
        self._alike = map.descriptor_metric.max_distance
        self._distinct = distinct
        self._doubtful = _doubtful_images(map)
        self._directions = viewing_directions(map)
        self._sizes = sizes
        self._centers = np.array([image.projection_center() for image in map.images.values()])

    def evidence(
        self,
        query: Query,
        matches: PointMatches,
        pose: PoseEstimate,
        camera: pycolmap.Camera,
        *,
        calibrated: bool = False,
    ) -> Evidence:
        """Collect the evidence for a pose.

        Args:
            query: The query.
            matches: The matches that the pose was estimated from.
            pose: The pose.
            camera: The query's intrinsics.
            calibrated: Whether they were given with the query.
        """
        agreeing, points = matches.keypoints[pose.inliers], matches.points[pose.inliers]
        others, predicted_error = ~pose.inliers, pose.predicted_corner_error(self._box)
        return Evidence(
            inliers=_count(agreeing),
            distinct=_count(agreeing[self._distinct[points]]),
            matched=_count(matches.keypoints),
            predicted_error=predicted_error,
            rival=self._rival(matches, matches.pixels(query), others, pose, camera),
            found=self._found(query, points, pose, camera),
            uncalibrated_error=self._uncalibrated_error(pose),
            misfit=misfit(pose.check, pose.estimated) if pose.check else 0.0,
            cells=_cells(matches.pixels(query)[pose.inliers], camera),
            facing=self._facing(points, pose),
            doubted=self._doubted(pose),
            determined=self._determined(pose, predicted_error),
            calibrated=calibrated,
            extractor=self._extractor,
        )

    def determined(self, evidence: Evidence, pose: PoseEstimate) -> Evidence:
        """The evidence for a pose after it was refined over other matches that were looked for near it.

        How well they determine the pose is theirs. What supports and what contradicts it stays, because such
        matches agree with a wrong pose too.
        """
        predicted_error = pose.predicted_corner_error(self._box)
        return replace(
            evidence,
            predicted_error=predicted_error,
            uncalibrated_error=self._uncalibrated_error(pose),
            determined=self._determined(pose, predicted_error),
        )

    def _determined(self, pose: PoseEstimate, predicted_error: float) -> float:
        if predicted_error < _DETERMINED:
            return 1.0
        return pose.probability_within(ADD_FRACTIONS[0] * inflation(pose.estimated), self._box)

    def _facing(self, points: Ids, pose: PoseEstimate) -> float:
        """Share of points that are seen from the side from which the references saw them."""
        directions = self._directions[points]
        towards = pose.cam_from_world.inverse().translation - self._points3D_in_world[points]
        sided = np.linalg.norm(directions, axis=1) > _ONE_SIDED
        return 1 - float(np.mean(sided & (np.einsum("nd,nd->n", towards, directions) < 0)))

    def _uncalibrated_error(self, pose: PoseEstimate) -> float:
        if pose.covariance is None or pose.check is None:
            return 1.0
        whole = replace(pose, covariance=pose.covariance + pose.check.growth)
        return whole.predicted_corner_error(self._box)

    def _doubted(self, pose: PoseEstimate) -> bool:
        center = pose.cam_from_world.inverse().translation
        nearest = np.argsort(np.linalg.norm(self._centers - center, axis=1), kind="stable")[:_NEAREST]
        return bool(self._doubtful[nearest].any())

    def _rival(
        self,
        matches: PointMatches,
        pixels: Points2D,
        others: Mask,
        pose: PoseEstimate,
        camera: pycolmap.Camera,
    ) -> int:
        """Number of keypoints that agree with the best other pose, among matches that contradict this one."""
        keypoints, points3D = matches.keypoints[others], self._points3D_in_world[matches.points[others]]
        other = estimate_pose(pixels[others], points3D, camera, RIVAL_RANSAC)
        if other is None:
            return 0
        apart = corner_error(other.cam_from_world, pose.cam_from_world, self._box)
        return 0 if apart < ADD_FRACTIONS[0] else _count(keypoints[other.inliers])

    def _found(self, query: Query, agreeing: Ids, pose: PoseEstimate, camera: pycolmap.Camera) -> float:
        """Share of the points that should be visible that are found where they project and nowhere else."""
        descriptors, points = self._strategy.visible_points(pose.cam_from_world, agreeing)
        pixels = project(self._points3D_in_world[points], pose.cam_from_world, camera)
        inside = np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1)
        visible = np.flatnonzero(inside & self._sizes.show(points, pose.cam_from_world, camera))
        if not len(visible):
            return 0.0
        visible = visible[some_points(points[visible], _CHECKED)]
        target = descriptors[visible], points[visible]
        return float(_found_there_alone(query, pixels[visible], target, self._alike).mean())


def _doubtful_images(map: Map) -> Mask:
    """Which reference images, in order of name, see what contradicted images see."""
    doubtful = map.info.quality.doubtful if map.info.quality else ()
    return np.array([name in doubtful for name in map.images], bool)


def _cells(pixels: Points2D, camera: pycolmap.Camera) -> int:
    side_px = max(camera.width, camera.height) / _CELLS
    return len(np.unique(np.floor(pixels / side_px) @ (1.0, 1000.0)))


def _count(keypoints: Ids) -> int:
    """Number of different keypoints; one keypoint may be matched with several points."""
    return len(np.unique(keypoints))


def _found_there_alone(
    query: Query, places: Points2D, target: Target, alike: float
) -> Bool[np.ndarray, " points"]:
    """Which points have a similar keypoint near their place, and no equally similar one far from it."""
    keypoints = query.keypoints[:_STRONGEST]
    if not len(keypoints):  # the strategy finds places itself
        return np.zeros(len(places), dtype=bool)
    cosines, firsts = best_cosines(query.descriptors[:_STRONGEST], target)
    cosines, places = cosines.T, places[firsts]
    best = cosines.argmax(axis=1)
    angles = np.arccos(np.clip(cosines[np.arange(len(places)), best], -1, 1))
    found = (np.linalg.norm(places - keypoints[best], axis=1) < _NEAR_PX) & (angles <= alike)
    rows = np.flatnonzero(found)
    which, others = np.nonzero(cosines[rows] > np.cos(angles[rows] / _MAX_RATIO)[:, None])
    apart = np.linalg.norm(places[rows[which]] - keypoints[others], axis=1) > _FAR_PX
    found[rows[which[apart]]] = False
    return found
