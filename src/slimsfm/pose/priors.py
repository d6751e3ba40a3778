"""Intrinsics that may be estimated with a pose, and what is expected of them and of gravity."""

from copy import copy
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.geometry import motions

_SHORTEST = 1e-100  # vector that is used as it is
_USUAL = 1.2  # focal length over the longer side, as COLMAP guesses
_TRIED = (0.23, 5.3)  # over the longer side: fields of view of 130 to 11 degrees
_POSSIBLE = (0.1, 10.0)  # over the longer side: COLMAP also rejects photographs beyond these
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
            if not _SHORTEST < np.abs(direction).max() < 1 / _SHORTEST:  # squares must be numbers
                object.__setattr__(self, name, direction / np.abs(direction).max())
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
        sigmas = np.array([*2 * (self.center_sigma,), _STRETCHED])
        now, expected = (one.params[one.principal_point_idxs()] for one in (camera, self.camera))
        center = (now - expected) / camera.mean_focal_length()
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
