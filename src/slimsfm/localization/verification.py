"""Is a pose right? One number says so: the probability that its corner error is below 0.1 of the diagonal.

Repeated texture, a twin of the object or a lucky few outliers give poses with many consistent inliers, so to
count those is not enough. Five things are looked at, each of which a wrong pose finds hard to have:

    distinct    how many keypoints agree with the pose whose points look like no other point of the map
    share       how many of the matched keypoints agree with it
    precision   how exactly the inliers fix the pose, were they right: the predicted corner error
    rival       how many keypoints agree with the best other pose, by the matches that disagree with this one
    found       which share of the points that should be visible has a keypoint that looks like it where it
                projects, and none elsewhere that does as well

Their sum with fixed weights is the log-odds of being right: logistic regression on rendered and photographed
scenes, some built to deceive, with weights held to the sign that reason demands. `benchmarks/confidence.py`
learns them and shows how well probabilities and truth agree on scenes that were not learned from.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Descriptors, Ids, Mask, Points2D
from slimsfm.geometry import corner_error, project
from slimsfm.localization.strategy import PointMatches, Query, Strategy
from slimsfm.mapping.map import Map, PointDescriptors
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose

RIGHT = 0.1
"""Relative corner error below which a pose is right."""

WEIGHTS = np.array([3.3, 0.95, 0.6, 0.55, 1.2, 1.05, 1.1])
"""Of the terms of `Evidence`, learned by `benchmarks/confidence.py`."""

_RIVAL = RansacOptions(min_inliers=6, max_iterations=150)  # finds what a third of the rest agrees with
_CLEAR = 0.75  # share of distinct inliers at which a pose is not ambiguous
_CHECKED = 100  # visible points that are looked for
_STRONGEST = 2048  # keypoints among which they are
_NEAR_PX, _FAR_PX = 5.0, 15.0  # from where a point projects: it is there, it is elsewhere
_MAX_RATIO = 0.9  # of the angle of the keypoint there to that of the best one elsewhere


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What speaks for and against a pose."""

    inliers: int
    """Keypoints that agree with it."""

    distinct: int
    """Those of them whose points look like no other point of the map."""

    matched: int
    """Keypoints that were matched."""

    predicted_error: float
    """Predicted relative corner error."""

    rival: int
    """Keypoints that agree with another pose, farther than a tenth of the diagonal, best of the rest."""

    found: float
    """Share of the points that should be visible that are found where they should be and nowhere else."""

    @property
    def confidence(self) -> float:
        """Probability that the pose is right."""
        return float(1 / (1 + np.exp(-np.clip(WEIGHTS @ self.terms, -50, 50))))

    @property
    def is_ambiguous(self) -> bool:
        """Whether many inliers could be elsewhere, or another pose shows: more should be looked at."""
        return self.distinct < _CLEAR * self.inliers or self.rival > _RIVAL.min_inliers

    @property
    def terms(self) -> Float64[np.ndarray, " terms"]:
        """What the weights are multiplied with: a constant, and what grows with what speaks for the pose."""
        return np.array(
            [
                1.0,
                np.log((self.distinct + 1) / 20),
                np.log(max(self.inliers / self.matched, 0.02)),
                -np.log(np.clip(self.predicted_error, 0.003, 0.3) / 0.01),
                -np.log(max(self.rival, 6) / 6),
                -min(self.rival / self.inliers, 1.0),
                self.found,
            ]
        )


class Verifier:
    """Collects the evidence for poses in one map."""

    def __init__(self, map: Map, strategy: Strategy, described: PointDescriptors) -> None:
        self._points3D_in_world = map.points3D_in_world
        self._box = map.box
        self._strategy = strategy
        self._alike = map.descriptor_metric.max_distance
        self._distinct = np.ones(len(map.point3D_ids), dtype=bool)
        if described.distinct is not None:
            self._distinct[described.points] = described.distinct

    def evidence(
        self, query: Query, matches: PointMatches, pose: PoseEstimate, camera: pycolmap.Camera
    ) -> Evidence:
        """Collect what speaks for and against a pose.

        Args:
            query: The query.
            matches: The matches that the pose was estimated from.
            pose: The pose.
            camera: The query's intrinsics.
        """
        agreeing, points = matches.keypoints[pose.inliers], matches.points[pose.inliers]
        others = ~pose.inliers
        return Evidence(
            inliers=_count(agreeing),
            distinct=_count(agreeing[self._distinct[points]]),
            matched=_count(matches.keypoints),
            predicted_error=pose.predicted_corner_error(self._box),
            rival=self._rival(matches, matches.pixels(query), others, pose, camera),
            found=self._found(query, points, pose, camera),
        )

    def _rival(
        self,
        matches: PointMatches,
        pixels: Points2D,
        others: Mask,
        pose: PoseEstimate,
        camera: pycolmap.Camera,
    ) -> int:
        """How many keypoints agree with the best other pose, by the matches that disagree with this one."""
        keypoints, points3D = matches.keypoints[others], self._points3D_in_world[matches.points[others]]
        other = estimate_pose(pixels[others], points3D, camera, _RIVAL)
        if other is None or corner_error(other.cam_from_world, pose.cam_from_world, self._box) < RIGHT:
            return 0
        return _count(keypoints[other.inliers])

    def _found(self, query: Query, agreeing: Ids, pose: PoseEstimate, camera: pycolmap.Camera) -> float:
        """Which share of what should be visible is found, and found nowhere else."""
        descriptors, points = self._strategy.visible_points(pose.cam_from_world, agreeing)
        pixels = project(self._points3D_in_world[points], pose.cam_from_world, camera)
        inside = np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1)
        visible = np.flatnonzero(inside)
        if not len(visible):
            return 0.0
        visible = visible[np.linspace(0, len(visible) - 1, min(_CHECKED, len(visible))).astype(int)]
        return float(_found_there_alone(query, pixels[visible], descriptors[visible], self._alike).mean())


def _count(keypoints: Ids) -> int:
    """How many different keypoints there are: one may be matched with several points."""
    return len(np.unique(keypoints))


def _found_there_alone(query: Query, places: Points2D, descriptors: Descriptors, alike: float) -> Mask:
    """Which places have a keypoint near them that looks as it should, better than any far from them."""
    keypoints = query.keypoints[:_STRONGEST]
    if not len(keypoints):
        return np.zeros(len(places), dtype=bool)
    cosines = descriptors @ query.descriptors[:_STRONGEST].T
    best = cosines.argmax(axis=1)
    angles = np.arccos(np.clip(cosines[np.arange(len(places)), best], -1, 1))
    found = (np.linalg.norm(places - keypoints[best], axis=1) < _NEAR_PX) & (angles <= alike)
    rows = np.flatnonzero(found)
    which, others = np.nonzero(cosines[rows] > np.cos(angles[rows] / _MAX_RATIO)[:, None])
    apart = np.linalg.norm(places[rows[which]] - keypoints[others], axis=1) > _FAR_PX
    found[rows[which[apart]]] = False
    return found
