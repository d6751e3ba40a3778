"""A pose estimate, and the priors that can go into it: focal length and direction of gravity."""

from copy import copy
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64

from slimsfm.arrays import Mask, Points2D, Points3D
from slimsfm.geometry import Box, motions

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

    def corner_bound(self, box: Box) -> float:
        """Relative corner error that the pose does not exceed with 95 % probability.

        Raises:
            ValueError: The pose has no covariance.
        """
        if self.covariance is None:
            raise ValueError("covariance must not be None to bound an error; estimate_pose computes it")
        moved = motions(self.cam_from_world * box.corners).reshape(24, 6) / np.sqrt(8)
        return bound_95(moved @ self.covariance @ moved.T) / box.diagonal

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
    mean, square = np.trace(covariance), np.sum(covariance * covariance.T)
    if not mean > 0:
        return 0.0
    part = 2 * square / (9 * mean**2)  # 2 / 9 over the degrees of freedom
    return float(np.sqrt(mean) * (1 - part + _NORMAL_95 * np.sqrt(part)) ** 1.5)


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
    pinhole_points2D: Points2D, points3D_in_world: Points3D, cam_from_world: pycolmap.Rigid3d, focal_px: float
) -> Float64[np.ndarray, "6 6"]:
    """Covariance of a pose from matches: the inverse of their information, scaled by their residuals.

    The variance of a pixel is that of the reprojection errors, but at least that of `MIN_SIGMA_PX`. Where the
    matches leave a motion of the camera free, for example when all lie on one line, its variance is huge.

    Args:
        pinhole_points2D: Pixels of an ideal pinhole camera, principal point (0, 0).
        points3D_in_world: The point matched with each pixel.
        cam_from_world: The pose.
        focal_px: Focal length in pixels.
    """
    in_cam = cam_from_world * points3D_in_world
    jacobian = projection_jacobian(in_cam, focal_px).reshape(-1, 6)
    squares = np.sum((focal_px * in_cam[:, :2] / in_cam[:, 2:] - pinhole_points2D) ** 2)
    variance = max(squares / max(2 * len(in_cam) - 6, 1), MIN_SIGMA_PX**2)
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    return variance * (vectors / np.maximum(values, 1e-12 * values[-1])) @ vectors.T


_USUAL = 1.2  # focal length over the longer side, as COLMAP guesses
_TRIED = (0.23, 5.3)  # over the longer side: fields of view of 130 to 11 degrees
_POSSIBLE = (0.1, 10.0)  # over the longer side: COLMAP also rejects photographs beyond these
_NORMAL_95 = 1.6449  # quantile of the normal distribution
_EXIF_SIGMA = 0.15  # standard deviation of the logarithm of a focal length from EXIF
_CROPPED = 0.2  # standard deviation of a crop's principal point, over the longer side
_STRETCHED = 0.2  # standard deviation of the logarithm of a pixel's aspect ratio
_WITH_TWO = {
    "SIMPLE_PINHOLE": ("PINHOLE", 4),
    "SIMPLE_RADIAL": ("OPENCV", 8),
    "RADIAL": ("OPENCV", 8),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", 8),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", 8),
}  # model with two focal lengths, and its number of parameters
_STRIDE = 1.43  # ratio of successive focal lengths to try; an error of a fifth leaves a third of the inliers


def check_has_focal_length(camera: pycolmap.Camera) -> None:
    """Check that the camera is not spherical.

    Raises:
        ValueError: The camera is spherical and has no focal length, which a pinhole solver needs.
    """
    if camera.is_spherical():
        raise ValueError(f"camera must have a focal length, got the spherical model {camera.model_name}")


UNKNOWNS = 10
"""Number of unknowns of a refinement: a motion in the camera's frame (rotation in radians, then translation
in map units), the logarithm of the focal length, a shift of the principal point in focal lengths, and the
logarithm of the ratio of the two focal lengths."""

FOCAL, CENTER, ASPECT = 6, slice(7, 9), 9
"""Where the intrinsics are among the unknowns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PriorRows:
    """Residuals of a prior at one pose and camera, and their derivative."""

    residuals: Float64[np.ndarray, " k"]
    """Deviations from the expected values, in standard deviations."""

    jacobian: Float64[np.ndarray, "k 10"]
    """Change of the residuals with the unknowns, see `UNKNOWNS`."""


@runtime_checkable
class Prior(Protocol):
    """Knowledge about pose and camera that `refine_pose` weighs against the matches."""

    def rows(self, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> PriorRows:
        """Compare a pose and camera with the expected ones."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Gravity:
    """The direction of gravity in the map and in the camera, as an accelerometer measures it."""

    in_world: Float64[np.ndarray, "3"]
    """Direction in the frame of the map, of any length."""

    in_cam: Float64[np.ndarray, "3"]
    """Direction in the frame of the camera (x right in the upright image, y down, z forward), of any
    length."""

    uncertainty_deg: float = 2.0
    """Standard deviation, about either horizontal axis, of the angle between the two."""

    def __post_init__(self) -> None:
        for name, direction in (("in_world", self.in_world), ("in_cam", self.in_cam)):
            if not np.all(np.isfinite(direction)) or not np.any(direction):
                raise ValueError(f"{name} must be finite and not zero, got {direction.tolist()}")
        if not 0 < self.uncertainty_deg < 90:
            raise ValueError(f"uncertainty_deg must be between 0 and 90, got {self.uncertainty_deg}")

    def rows(self, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> PriorRows:  # noqa: ARG002
        """The map's direction rotated into the camera, minus the camera's direction."""
        sigma = np.radians(self.uncertainty_deg)
        down = cam_from_world.rotation.matrix() @ _unit(self.in_world)
        jacobian = np.zeros((3, UNKNOWNS))
        jacobian[:, :3] = motions(down[None])[0, :, :3]
        return PriorRows(residuals=(down - _unit(self.in_cam)) / sigma, jacobian=jacobian / sigma)


@dataclass(frozen=True, kw_only=True, eq=False)
class FocalPrior:
    """The expected focal length of a camera whose focal length is to be estimated."""

    expected_px: float
    """Most likely focal length in pixels."""

    log_sigma: float
    """Standard deviation of its logarithm."""

    limits_px: tuple[float, float]
    """Smallest and largest focal length allowed."""

    tried_px: Float64[np.ndarray, " k"]
    """Focal lengths at which hypotheses are searched, the likely ones first."""

    @classmethod
    def of(cls, camera: pycolmap.Camera, relative_uncertainty: float | None = None) -> "FocalPrior":
        """Expect a focal length near that of a camera, or any.

        Args:
            camera: A camera with a focal length and, if the uncertainty is None, the size of the image.
            relative_uncertainty: Largest relative error of the camera's focal length: 0.3 allows 30 %. None
                ignores the camera's focal length: expected is 1.2 times the longer side of the image, within
                a factor of 2, and allowed is anything from 0.1 to 10 times the longer side.

        Raises:
            ValueError: The camera is spherical, its focal length or size is not positive, or the uncertainty
                is not between 0 and 1.
        """
        check_has_focal_length(camera)
        if not np.all(camera.params[camera.focal_length_idxs()] > 0):
            raise ValueError(f"camera must have a positive focal length, got {camera.params_to_string()}")
        if relative_uncertainty is None:
            return cls._unknown(camera)
        if not 0 < relative_uncertainty < 1:
            raise ValueError(f"relative_uncertainty must be between 0 and 1, got {relative_uncertainty}")
        expected_px = camera.mean_focal_length()
        # covers an error relative to the expected focal length and one relative to the true focal length
        limits_px = (expected_px * (1 - relative_uncertainty), expected_px / (1 - relative_uncertainty))
        return cls(
            expected_px=expected_px,
            log_sigma=-np.log1p(-relative_uncertainty) / 2,
            limits_px=limits_px,
            tried_px=_grid(*limits_px, expected_px),
        )

    @classmethod
    def _unknown(cls, camera: pycolmap.Camera) -> "FocalPrior":
        if not (camera.width > 0 and camera.height > 0):
            raise ValueError(f"camera must have the size of the image, got {camera.width}x{camera.height}")
        longer_px = max(camera.width, camera.height)
        return cls(
            expected_px=_USUAL * longer_px,
            log_sigma=np.log(2),
            limits_px=(_POSSIBLE[0] * longer_px, _POSSIBLE[1] * longer_px),
            tried_px=_grid(_TRIED[0] * longer_px, _TRIED[1] * longer_px, _USUAL * longer_px),
        )

    @classmethod
    def near(cls, camera: pycolmap.Camera) -> "FocalPrior":
        """Expect a focal length near that of a camera, to 15 %, but allow any: as EXIF data say.

        Raises:
            ValueError: As in `of`.
        """
        anywhere, expected_px = cls.of(camera), camera.mean_focal_length()
        low_px, high_px = (limit * max(camera.width, camera.height) for limit in (min(_TRIED), max(_TRIED)))
        return replace(
            anywhere,
            expected_px=expected_px,
            log_sigma=_EXIF_SIGMA,
            tried_px=_grid(min(low_px, expected_px / 2), max(high_px, 2 * expected_px), expected_px),
        )

    def rows(self, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> PriorRows:  # noqa: ARG002
        """Logarithm of the camera's focal length, minus that of the expected focal length."""
        deviation = np.log(camera.mean_focal_length() / self.expected_px) / self.log_sigma
        row = np.eye(UNKNOWNS)[FOCAL : FOCAL + 1] / self.log_sigma
        return PriorRows(residuals=np.array([deviation]), jacobian=row)


@dataclass(frozen=True, kw_only=True, eq=False)
class FramePrior:
    """Where the principal point and the pixel aspect ratio of a cropped or stretched image are expected."""

    camera: pycolmap.Camera
    """The camera of the image if it was neither cropped nor stretched."""

    center: bool = True
    """Whether the principal point may differ: about a fifth of the longer side."""

    aspect: bool = False
    """Whether the ratio of the focal lengths may differ: about a fifth. The camera must have two."""

    @property
    def center_sigma(self) -> float:
        """Standard deviation of the principal point, in focal lengths."""
        longer_px = max(self.camera.width, self.camera.height)
        return _CROPPED * longer_px / self.camera.mean_focal_length()

    def rows(self, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> PriorRows:  # noqa: ARG002
        """Deviations of the principal point and of the logarithm of the aspect ratio."""
        at, sigmas = camera.principal_point_idxs(), np.array([*2 * (self.center_sigma,), _STRETCHED])
        center = (camera.params[at] - self.camera.params[at]) / camera.mean_focal_length()
        changes = np.array([*center, log_aspect(camera) - log_aspect(self.camera)])
        free = [self.center, self.center, self.aspect]
        jacobian = np.eye(UNKNOWNS)[CENTER.start :] / sigmas[:, None]
        return PriorRows(residuals=(changes / sigmas)[free], jacobian=jacobian[free])


def log_aspect(camera: pycolmap.Camera) -> float:
    """Logarithm of the ratio of the focal lengths in x and y; 0 for a camera with one."""
    focal_px = camera.params[camera.focal_length_idxs()]
    return float(np.log(focal_px[0] / focal_px[-1]))


def with_two_focal_lengths(camera: pycolmap.Camera) -> pycolmap.Camera | None:
    """An equal camera of a model with two focal lengths; None if there is no such model."""
    if len(camera.focal_length_idxs()) == 2:
        return camera
    if camera.model_name not in _WITH_TWO:
        return None
    focal_px, *rest = camera.params.tolist()
    model, count = _WITH_TWO[camera.model_name]
    params = [focal_px, focal_px, *rest]
    return pycolmap.Camera(
        model=model,
        width=camera.width,
        height=camera.height,
        params=[*params, *[0.0] * (count - len(params))],
        camera_id=camera.camera_id,
    )


def with_focal_length(camera: pycolmap.Camera, focal_px: float) -> pycolmap.Camera:
    """A copy of the camera with another mean focal length and equal distortion in normalized coordinates."""
    params = camera.params.copy()
    params[camera.focal_length_idxs()] *= focal_px / camera.mean_focal_length()
    changed = copy(camera)
    changed.params = params.tolist()
    return changed


def _grid(low: float, high: float, expected: float) -> Float64[np.ndarray, " k"]:
    """Geometric means of the parts of a range, each part one stride wide or less; likely ones first."""
    count = int(np.ceil(np.log(high / low) / np.log(_STRIDE)))
    values = low * (high / low) ** ((np.arange(count) + 0.5) / count)
    return values[np.argsort(np.abs(np.log(values / expected)), kind="stable")]


def _unit(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    return direction / np.linalg.norm(direction)
