"""Confidence of a pose: the probability that its corner error is below 0.1 of the diagonal.

Repeated texture, a second object that looks the same, or a few chance outliers give wrong poses with many
consistent inliers, and so does a wrong camera: counting inliers is not enough. The confidence
uses quantities that are rarely good for a wrong pose:

    distinct    number of keypoints that agree with the pose and whose point looks like no other of the map
    share       share of the matched keypoints that agree with the pose
    precision   the predicted corner error: how well the inliers determine the pose if they are right
    rival       number of keypoints that agree with the best other pose, among matches that disagree with
                this one
    found       share of the points that should be visible that have a similar keypoint where they project,
                and no equally similar one elsewhere
    intrinsics  the corner error that a wrong camera could cause without being noticed, and how much the
                matches contradict the camera
    spread      number of squares of the image with inliers

Their weighted sum is the log-odds that the pose is right. The weights, by extractor in `calibration`, come
from logistic regression on rendered and photographed scenes, whose queries are zoomed, cropped, blurred,
dark, hidden, mirrored, or of another scene; signs are constrained to the plausible ones.
`benchmarks/confidence.py` learns the weights and measures the calibration on held-out scenes. A pose that
sees the surface from behind is not believed at all.
No confidence exceeds the probability, by the covariance of the pose, that its corner error is below 0.1 if
all of its inliers are right. That is of the covariance before its inflation for the 95 % bounds, which most
errors do not nearly reach; where the predicted error, which includes it, is above 0.1, the confidence is at
most 0.9, so that the pose is never sure.

Where only the unproven camera is against a pose, but was given with the query and is not contradicted, the
confidence is what it would be if matches proved the camera, though at most 0.7.

This holds on right maps. Next to images that the map's own matches contradict, because the map may be folded
there, 60 % of the confidence remains.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.localization.calibration import evidence_weights
from slimsfm.pose import RansacOptions

RIVAL_RANSAC = RansacOptions(min_inliers=6, max_iterations=150)
"""How the best other pose is estimated: finds a pose that a third of the remaining matches agrees with."""

UNAMBIGUOUS = 0.75
"""Share of distinct inliers from which a pose is unambiguous."""

_DOUBTED = 0.6  # of the confidence, next to contradicted images
_UNPROVEN = 0.1  # largest corner error by wrong intrinsics that counts against the matches themselves
_GIVEN = 0.7  # most, where only the user says what the intrinsics are: given ones are wrong at times
_VAGUE = 0.9  # most, where the predicted error is above that of a right pose
_BEHIND = 0.02  # of the confidence, where most points are seen from behind: a mirrored photo of a plane is
_LEAST_FACING = 0.5  # share of the points that must be seen from the side they were seen from


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What supports and what contradicts a pose."""

    inliers: int
    """Number of keypoints that agree with the pose."""

    distinct: int
    """Number of those keypoints whose point looks like no other point of the map."""

    matched: int
    """Number of matched keypoints."""

    predicted_error: float
    """Predicted relative corner error, if the inliers are right."""

    rival: int
    """Number of keypoints that agree with the best other pose, at a corner error of at least 0.1."""

    found: float
    """Share of the points that should be visible that are found where they project and nowhere else."""

    uncalibrated_error: float
    """Predicted relative corner error if nothing but the matches said what the intrinsics are."""

    misfit: float
    """How much the matches contradict the intrinsics: 1 is where more of them would have been estimated."""

    cells: int
    """Number of squares, a sixteenth of the longer side wide, with keypoints that agree with the pose."""

    facing: float = 1.0
    """Share of the points that agree with the pose and that it sees from the side they were seen from."""

    doubted: bool = False
    """Whether matches contradict the poses of the reference images next to the pose."""

    determined: float = 1.0
    """Probability that the corner error is below 0.1, if the inliers are right."""

    calibrated: bool = False
    """Whether the intrinsics were given with the query, not taken from the map or the photo's EXIF data."""

    extractor: str = "sift"
    """Name of the extractor of the features, by which the evidence is weighed."""

    @property
    def confidence(self) -> float:
        """Probability that the pose is right."""
        learned = self._learned
        if self.calibrated and self.misfit < 1 and self.uncalibrated_error > _UNPROVEN:
            proven = replace(self, uncalibrated_error=_UNPROVEN)
            learned = max(learned, min(proven._learned, _GIVEN))
        on_right_map = min(learned, self.limit)
        if self.is_behind:
            return on_right_map * _BEHIND
        return on_right_map * (_DOUBTED if self.doubted else 1.0)

    @property
    def _learned(self) -> float:
        log_odds = evidence_weights(self.extractor) @ self.terms
        return float(1 / (1 + np.exp(-np.clip(log_odds, -50, 50))))

    @property
    def limit(self) -> float:
        """Largest confidence that the covariance of the pose allows."""
        is_vague = self.predicted_error > ADD_FRACTIONS[0]
        return min(self.determined, _VAGUE if is_vague else 1.0)

    @property
    def confidence_in_matches(self) -> float:
        """The confidence, if twice as many matches proved the intrinsics no better than they mostly do.

        Features of a larger image would hardly change more, unless the intrinsics are wrong.
        """
        provable = max(min(self.uncalibrated_error, _UNPROVEN), self.uncalibrated_error / 2)
        return replace(self, uncalibrated_error=provable).confidence

    @property
    def is_behind(self) -> bool:
        """Whether the pose sees the surface from behind, as that of a mirrored photo of a plane does."""
        return self.facing < _LEAST_FACING

    @property
    def is_ambiguous(self) -> bool:
        """Whether many inliers look like other points, or another pose has support: more matches help."""
        return self.distinct < UNAMBIGUOUS * self.inliers or self.rival > RIVAL_RANSAC.min_inliers

    @property
    def terms(self) -> Float64[np.ndarray, " terms"]:
        """Factors of the weights: a constant, then quantities that grow with the support for the pose."""
        return np.array(
            [
                1.0,
                np.log((self.distinct + 1) / 20),
                np.log(max(self.inliers / self.matched, 0.02)),
                -np.log(np.clip(self.predicted_error, 0.003, 0.3) / 0.01),
                -np.log(max(self.rival, 6) / 6),
                -min(self.rival / self.inliers, 1.0),
                self.found,
                -np.log(np.clip(self.predicted_error, 0.04, 1.0) / 0.04),
                -np.log(np.clip(self.uncalibrated_error, 0.02, 1.0) / 0.1),
                -min(self.misfit, 1.0),
                np.log(np.clip(self.cells, 1, 30) / 10),
            ]
        )
