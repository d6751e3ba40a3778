"""A pose estimate, its uncertainty, and what its matches say about the camera."""

from dataclasses import dataclass
from math import isfinite
from statistics import NormalDist

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64

from slimsfm.arrays import Mask, Points2D, Points3D
from slimsfm.geometry import Box, motions

_NORMAL_95 = 1.6449  # quantile of the normal distribution

MIN_SIGMA_PX = 0.5
"""Smallest standard deviation of a keypoint that a covariance assumes: no detector is more accurate."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraCheck:
    """What matches say about the intrinsics of an image."""

    decreases: dict[str, float]
    """By how much the squared errors, in sigmas, would decrease if each of the intrinsics changed."""

    changes: dict[str, float]
    """By how much each would change: the logarithm of the focal length, the principal point in focal lengths,
    the logarithm of the aspect ratio."""

    growth: Float64[np.ndarray, "6 6"]
    """Mean square of the motion of the pose if nothing but the matches said what the intrinsics are: large
    where a wrong camera could not be noticed, and where others would fit better."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseEstimate:
    """The pose of a camera, and the matches that support it."""

    cam_from_world: pycolmap.Rigid3d
    """The pose."""

    inliers: Mask
    """Which of the given matches agree with the pose."""

    covariance: Float64[np.ndarray, "6 6"] | None = None
    """Covariance of the small motion in the camera's frame (rotation in radians, then translation in map
    units) from this pose to the true one, assuming that the inliers are correct. None where it was not
    computed."""

    confidence: float | None = None
    """Probability that the pose is right: that its corner error is below a tenth of the diagonal. None where
    the pose was not verified."""

    camera: pycolmap.Camera | None = None
    """The given camera with the estimated intrinsics; None where none was estimated."""

    relative_focal_sigma: float | None = None
    """Standard deviation of the estimated focal length, divided by the focal length. Where the matches do not
    determine it, as on a wall seen from the front, it is about as large as that of the prior. None where the
    focal length was known."""

    estimated: tuple[str, ...] = ()
    """Names of the intrinsics that were estimated with the pose: "focal length", "principal point", "pixel
    aspect ratio"."""

    check: CameraCheck | None = None
    """What the matches say about the intrinsics. None where they were not checked."""

    @property
    def num_inliers(self) -> int:
        """Number of matches that agree with the pose."""
        return int(self.inliers.sum())

    @property
    def position_bound(self) -> float | None:
        """Distance, in map units, within which the camera truly is with 95 % probability."""
        return None if self.covariance is None else bound_95(self.covariance[3:, 3:])

    @property
    def rotation_bound_deg(self) -> float | None:
        """Angle within which the true rotation is with 95 % probability, at most 180."""
        if self.covariance is None:
            return None
        return float(min(np.degrees(bound_95(self.covariance[:3, :3])), 180.0))

    @property
    def is_finite(self) -> bool:
        """Whether all of its numbers are."""
        numbers = [self.cam_from_world.matrix()]
        numbers += [] if self.camera is None else [self.camera.params]
        numbers += [] if self.covariance is None else [self.covariance]
        return isfinite(sum(float(one.sum()) for one in numbers))

    def probability_within(self, fraction: float, box: Box) -> float:
        """Probability that the corner error is below a fraction of the diagonal, if the inliers are right.

        Raises:
            ValueError: The pose has no covariance.
        """
        return probability_below(fraction * box.diagonal, self._corner_covariance(box))

    def corner_bound(self, box: Box) -> float:
        """Relative corner error that the pose does not exceed with 95 % probability.

        Raises:
            ValueError: The pose has no covariance.
        """
        return bound_95(self._corner_covariance(box)) / box.diagonal

    def _corner_covariance(self, box: Box) -> Float64[np.ndarray, "24 24"]:
        """Covariance of the displacements of all corners, over the root of their number."""
        if self.covariance is None:
            raise ValueError("covariance must not be None to bound an error; estimate_pose computes it")
        moved = motions(self.cam_from_world * box.corners).reshape(24, 6) / np.sqrt(8)
        return moved @ self.covariance @ moved.T

    def predicted_corner_error(self, box: Box) -> float:
        """Predict the relative corner error, assuming that the inliers are correct.

        The covariance is propagated to the corners of the box. The prediction is the mean over the eight
        corners of the root mean square displacement of each, divided by the diagonal: the counterpart of
        `geometry.corner_error`, which is a mean of distances. See `rms_corner_errors` for the other average.

        Raises:
            ValueError: The pose has no covariance.
        """
        if self.covariance is None:
            raise ValueError("covariance must not be None to predict an error; estimate_pose computes it")
        moved = motions(self.cam_from_world * box.corners)
        squares = np.einsum("nia,ab,nib->n", moved, self.covariance, moved)
        return float(np.sqrt(np.maximum(squares, 0)).mean() / box.diagonal)


def bound_95(covariance: Float64[np.ndarray, "k k"]) -> float:
    """Length that a normally distributed vector of mean zero does not exceed with 95 % probability.

    The squared length is taken for a multiple of a chi-squared variable of the same mean and variance, whose
    quantile is that of Wilson and Hilferty; within 2 % of the exact one.
    """
    mean, part = _squared_length(covariance)
    return float(np.sqrt(mean) * (1 - part + _NORMAL_95 * np.sqrt(part)) ** 1.5) if mean > 0 else 0.0


def probability_below(length: float, covariance: Float64[np.ndarray, "k k"]) -> float:
    """Probability that a normally distributed vector of mean zero is shorter than `length`, as `bound_95`."""
    mean, part = _squared_length(covariance)
    if not mean > 0:
        return 1.0
    return NormalDist(1 - part, part**0.5).cdf((length**2 / mean) ** (1 / 3))


def _squared_length(covariance: Float64[np.ndarray, "k k"]) -> tuple[float, float]:
    """Mean of the squared length of a normal vector, and 2 / 9 over its degrees of freedom."""
    mean, square = np.trace(covariance), np.sum(covariance * covariance.T)
    return (float(mean), float(2 * square / (9 * mean**2))) if mean > 0 else (0.0, 0.0)


def rms_corner_errors(
    covariances: Float64[np.ndarray, "n 6 6"], corner_motions: Float32[np.ndarray, "n 24 6"]
) -> Float64[np.ndarray, " n"]:
    """Root mean square displacement over all corners of the box, in diagonals, for many poses at once.

    It is an upper bound of `PoseEstimate.predicted_corner_error`, usually a few percent larger, and needs one
    batched product. Choosing points only compares poses with it, thousands of times per choice; everything
    that is reported or thresholded uses `predicted_corner_error`.

    Args:
        covariances: Covariances of the poses' six parameters.
        corner_motions: How the 24 coordinates of the corners, in diagonals, change with these parameters.
    """
    squares = np.einsum("nca,nca->n", corner_motions @ covariances, corner_motions)
    return np.sqrt(squares / 8)


def projection_jacobian(points3D_in_cam: Points3D, focal_px: float) -> Float64[np.ndarray, "n 2 6"]:
    """How the pixels of points change with a motion in the camera's frame, for an ideal pinhole camera.

    Args:
        points3D_in_cam: Points in the camera's frame.
        focal_px: Focal length in pixels.

    Returns:
        Pixels per radian of rotation (first three columns) and per map unit of translation.
    """
    x, y, z = points3D_in_cam.T
    zero = np.zeros_like(z)
    pixels_from_cam = np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]]).transpose(2, 0, 1)
    return focal_px * pixels_from_cam @ motions(points3D_in_cam)


def pose_covariance(
    pinhole_points2D: Points2D,
    points3D_in_world: Points3D,
    cam_from_world: pycolmap.Rigid3d,
    focal_px: float,
    spreads: Float64[np.ndarray, " n"] | None = None,
) -> Float64[np.ndarray, "6 6"]:
    """Covariance of a pose from matches: the inverse of their information, scaled by their residuals.

    The variance of a pixel is that of the reprojection errors, but at least that of `MIN_SIGMA_PX`. Where the
    matches leave a motion of the camera free, for example when all lie on one line, its variance is huge.
    With spreads, the variance of a pixel is that of the most exact matches.

    Args:
        pinhole_points2D: Pixels of an ideal pinhole camera, principal point (0, 0).
        points3D_in_world: The point matched with each pixel.
        cam_from_world: The pose.
        focal_px: Focal length in pixels.
        spreads: How much less exact each match is than the most exact ones, at least 1; None: all are equal.
    """
    in_cam = cam_from_world * points3D_in_world
    units = np.ones(len(in_cam)) if spreads is None else spreads
    jacobian = (projection_jacobian(in_cam, focal_px) / units[:, None, None]).reshape(-1, 6)
    errors = (focal_px * in_cam[:, :2] / in_cam[:, 2:] - pinhole_points2D) / units[:, None]
    squares = np.sum(errors**2)
    variance = max(squares / max(2 * len(in_cam) - 6, 1), MIN_SIGMA_PX**2)
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    return variance * (vectors / np.maximum(values, 1e-12 * values[-1])) @ vectors.T
