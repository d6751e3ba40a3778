"""Is a pose right? One number says so: the probability that its corner error is below 0.1 of the diagonal.

Repeated texture, a twin of the object or a lucky few outliers give poses with many consistent inliers, so to
count those is not enough. Five things are looked at, each of which a wrong pose finds hard to have:

    inliers     how many keypoints agree with the pose
    share       ... of all that were matched
    precision   how exactly the inliers fix the pose, were they right: the predicted corner error
    rival       how many keypoints agree with the best other pose among the matches that disagree with this
    found       which share of the points that should be visible has a keypoint that looks like it where it
                projects, beyond the share that finds one at random places nearby

Their sum with fixed weights is the log-odds of being right: logistic regression on rendered and photographed
scenes, some built to deceive, with weights held to the sign that reason demands. `benchmarks/confidence.py`
learns them and shows how well probabilities and truth agree on scenes that were not learned from.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree

from slimsfm.arrays import Descriptors, Ids, Points2D
from slimsfm.geometry import corner_error, project
from slimsfm.localization.strategy import PointMatches, Query, Strategy
from slimsfm.mapping.map import Map
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose

RIGHT = 0.1
"""Relative corner error below which a pose is right."""

WEIGHTS = np.array([1.0, 2.0, 1.0, 0.7, 4.0, 6.0])
"""Of the terms of `Evidence`, learned by `benchmarks/confidence.py`."""

_RIVAL = RansacOptions(min_inliers=6, max_iterations=150)  # finds what a third of the rest agrees with
_CHECKED = 150  # visible points that are looked for
_RADIUS_PX = 5.0  # around where they project
_SHIFTS_PX = 40.0 * np.array([(0.0, 0.0), (1.0, 0.0), (-0.5, 0.9), (-0.5, -0.9)])  # none, then by chance
_LEAST_COSINE = np.float32(np.cos(0.7))  # of two descriptors that look alike
_NEIGHBOURS = 4  # keypoints near a place that are compared


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What speaks for and against a pose."""

    inliers: int
    """Keypoints that agree with it."""

    matched: int
    """Keypoints that were matched."""

    predicted_error: float
    """Predicted relative corner error."""

    rival: int
    """Keypoints that agree with another pose, farther than a tenth of the diagonal, best of the rest."""

    found: float
    """Share of the points that should be visible and are found, beyond chance; at most 1."""

    @property
    def confidence(self) -> float:
        """Probability that the pose is right."""
        return float(1 / (1 + np.exp(-np.clip(WEIGHTS @ self.terms, -50, 50))))

    @property
    def terms(self) -> Float64[np.ndarray, " terms"]:
        """What the weights are multiplied with: a constant, and what grows with what speaks for the pose."""
        return np.array(
            [
                1.0,
                np.log(self.inliers / 20),
                np.log(self.inliers / self.matched),
                -np.log(self.predicted_error / 0.01),
                -self.rival / self.inliers,
                self.found,
            ]
        )


class Verifier:
    """Collects the evidence for poses in one map."""

    def __init__(self, map: Map, strategy: Strategy) -> None:
        self._points3D_in_world = map.points3D_in_world
        self._box = map.box
        self._strategy = strategy

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
        agrees = np.zeros(len(query.keypoints), dtype=bool)
        agrees[matches.keypoints[pose.inliers]] = True
        rest = np.flatnonzero(~agrees[matches.keypoints])
        num_agreeing, others = int(agrees.sum()), matches.keypoints[rest]
        return Evidence(
            inliers=num_agreeing,
            matched=num_agreeing + len(np.unique(others)),
            predicted_error=pose.predicted_corner_error(self._box),
            rival=self._rival(query.keypoints[others], matches.points[rest], pose, camera),
            found=self._found(query, matches.points[pose.inliers], pose, camera),
        )

    def _rival(self, points2D: Points2D, points: Ids, pose: PoseEstimate, camera: pycolmap.Camera) -> int:
        """How many keypoints agree with the best other pose."""
        other = estimate_pose(points2D, self._points3D_in_world[points], camera, _RIVAL)
        if other is None or corner_error(other.cam_from_world, pose.cam_from_world, self._box) < RIGHT:
            return 0
        return len(np.unique(points2D[other.inliers], axis=0))

    def _found(self, query: Query, agreeing: Ids, pose: PoseEstimate, camera: pycolmap.Camera) -> float:
        """Which share of what should be visible is found, beyond chance."""
        descriptors, points = self._strategy.expected(pose.cam_from_world, agreeing)
        pixels = project(self._points3D_in_world[points], pose.cam_from_world, camera)
        inside = np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1)
        visible = np.flatnonzero(inside)
        if not len(visible):
            return 0.0
        visible = visible[np.linspace(0, len(visible) - 1, min(_CHECKED, len(visible))).astype(int)]
        places = pixels[visible] + _SHIFTS_PX[:, None]
        shares = _resembled(query, places, descriptors[visible]).mean(axis=1)
        chance = float(shares[1:].mean())
        return float(shares[0] - chance) / max(1 - chance, 0.1)


def _resembled(
    query: Query, places: Float64[np.ndarray, "shifts n 2"], descriptors: Descriptors
) -> Bool[np.ndarray, "shifts n"]:
    """Which places have a keypoint near them that looks as it should."""
    tree = KDTree(query.keypoints, balanced_tree=False, compact_nodes=False)
    distances, rows = tree.query(places, k=_NEIGHBOURS, distance_upper_bound=_RADIUS_PX)
    shifts, points, columns = np.nonzero(np.isfinite(distances))
    near = np.asarray(rows)[shifts, points, columns]
    alike = np.einsum("nd,nd->n", query.descriptors[near], descriptors[points]) >= _LEAST_COSINE
    found = np.zeros(places.shape[:2], dtype=bool)
    found[shifts[alike], points[alike]] = True
    return found
