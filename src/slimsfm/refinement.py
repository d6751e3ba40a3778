"""The most probable pose, and focal length, near a first one: by reprojection errors and priors."""

from copy import copy
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Mask, Points2D, Points3D
from slimsfm.geometry import motions, project, reprojection_errors

_ROUNDS = 8  # of choosing inliers; 2 to 4 are common
_STEPS = 30  # of Levenberg and Marquardt in a round; 5 are common
_NEGLIGIBLE = 1e-6  # fall of the cost that ends a round: a thousandth of a sigma
_CAUCHY = 2.385  # sigmas at which the loss bends: 95 % as efficient as least squares, were errors normal
_LEAST_SIGMA_PX = 1e-3  # of exact matches; at zero the priors would weigh nothing
_LEAST_SIGMA_SEEN_PX = 0.5  # no detector places its keypoints more exactly
_MINIMAL = 4  # matches that a pose and a focal length need
_STEP = 1e-6  # of the numerical derivative of the lens, relative to depth


@dataclass(frozen=True, kw_only=True, eq=False)
class PriorRows:
    """What a prior says of one pose and camera."""

    residuals: Float64[np.ndarray, " k"]
    """How far they are from what was expected, in sigmas."""

    jacobian: Float64[np.ndarray, "k 7"]
    """Change with a motion in the camera's frame, a turn in radians and a shift in map units, and with the
    logarithm of the focal length."""


@runtime_checkable
class Prior(Protocol):
    """What is known of pose and camera besides the matches."""

    def rows(self, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> PriorRows:
        """Compare with what was expected."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """A most probable pose and camera, and the matches that agree with them."""

    cam_from_world: pycolmap.Rigid3d
    """The pose."""

    camera: pycolmap.Camera
    """The camera, with the focal length that was found."""

    inliers: Mask
    """Which of the given matches agree."""

    covariance: Float64[np.ndarray, "7 7"]
    """Of the small motion in the camera's frame, a turn in radians and then a shift in map units, that leads
    to the true pose, and of the logarithm of the focal length."""


def with_focal_length(camera: pycolmap.Camera, focal_px: float) -> pycolmap.Camera:
    """The camera with another mean focal length; what it does in normalized coordinates stays."""
    params = camera.params.copy()
    params[camera.focal_length_idxs()] *= focal_px / camera.mean_focal_length()
    changed = copy(camera)
    changed.params = params.tolist()
    return changed


def refine(
    points2D: Points2D,
    points3D_in_world: Points3D,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    *,
    max_error_px: float,
    priors: tuple[Prior, ...] = (),
    free_focal: bool = False,
) -> Refinement | None:
    """Refine a pose, and if wanted the focal length, by turns with the choice of the inliers.

    A round minimizes the Cauchy loss of the inliers' errors in the image, distortion and all, plus the
    squares of the priors' residuals, by the method of Levenberg and Marquardt. Errors count in sigmas, which
    is the scatter that the last round left. So a prior weighs what it should: hardly anything where the
    matches determine the pose, everything in a direction that they leave free.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map.
        cam_from_world: Where to start.
        camera: Any that has a focal length.
        max_error_px: Largest reprojection error of an inlier, and three sigmas at first.
        priors: What is known besides the matches.
        free_focal: Whether the focal length is sought too; two of them keep their ratio.

    Returns:
        The most probable pose and camera, or None when fewer than 4 matches agree with any.
    """
    problem = _Problem(
        pixels=points2D,
        in_world=points3D_in_world,
        sigma_px=max_error_px / 3,
        priors=priors,
        free_focal=free_focal,
    )
    fit = _Fit(cam_from_world=cam_from_world, camera=camera)
    errors = fit.errors(points2D, points3D_in_world)
    for last in range(_ROUNDS):
        inliers = errors < max_error_px
        if inliers.sum() < _MINIMAL:
            return None
        fit = _minimize(problem.of(inliers), fit)
        errors = fit.errors(points2D, points3D_in_world)
        sigma_px = float(np.clip(_scatter_px(errors[inliers]), _LEAST_SIGMA_PX, max_error_px / 3))
        problem = replace(problem, sigma_px=sigma_px)
        if last and np.array_equal(inliers, errors < max_error_px):
            break
    return _refinement(problem, fit, errors < max_error_px)


def _refinement(problem: "_Problem", fit: "_Fit", inliers: Mask) -> Refinement:
    seen = replace(problem.of(inliers), sigma_px=max(problem.sigma_px, _LEAST_SIGMA_SEEN_PX))
    return Refinement(
        cam_from_world=fit.cam_from_world,
        camera=fit.camera,
        inliers=inliers,
        covariance=_inverse(seen.information_and_gradient(fit)[0]),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera

    def moved(self, step: Float64[np.ndarray, "7"]) -> "_Fit":
        motion = pycolmap.Rigid3d(pycolmap.Rotation3d(step[:3]), step[3:6])
        focal_px = self.camera.mean_focal_length() * np.exp(np.clip(step[6], -0.5, 0.5))
        return _Fit(
            cam_from_world=motion * self.cam_from_world,
            camera=with_focal_length(self.camera, focal_px) if step[6] else self.camera,
        )

    def errors(self, points2D: Points2D, points3D_in_world: Points3D) -> Float64[np.ndarray, " n"]:
        return reprojection_errors(points2D, points3D_in_world, self.cam_from_world, self.camera)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Problem:
    pixels: Points2D
    in_world: Points3D
    sigma_px: float
    priors: tuple[Prior, ...]
    free_focal: bool

    def of(self, inliers: Mask) -> "_Problem":
        return replace(self, pixels=self.pixels[inliers], in_world=self.in_world[inliers])

    def cost(self, fit: _Fit) -> float:
        squares = (fit.errors(self.pixels, self.in_world) / self.sigma_px) ** 2
        return float(_CAUCHY**2 * np.log1p(squares / _CAUCHY**2).sum() + _squares(self.priors, fit))

    def information_and_gradient(
        self, fit: _Fit
    ) -> tuple[Float64[np.ndarray, "7 7"], Float64[np.ndarray, "7"]]:
        seen = project(self.in_world, fit.cam_from_world, fit.camera)
        residuals = (seen - self.pixels) / self.sigma_px
        jacobian = _jacobian(fit, self.in_world, seen) / self.sigma_px
        weights = 1 / (1 + np.sum(residuals**2, axis=1) / _CAUCHY**2)
        weighted = (weights[:, None, None] * jacobian).reshape(-1, 7)
        information = weighted.T @ jacobian.reshape(-1, 7)
        gradient = weighted.T @ residuals.ravel()
        for prior in self.priors:
            rows = prior.rows(fit.cam_from_world, fit.camera)
            information += rows.jacobian.T @ rows.jacobian
            gradient += rows.jacobian.T @ rows.residuals
        if not self.free_focal:
            information[6], information[:, 6], gradient[6] = 0, 0, 0
        return information, gradient


def _minimize(problem: _Problem, fit: _Fit) -> _Fit:
    damping, cost = 1e-3, problem.cost(fit)
    information, gradient = problem.information_and_gradient(fit)
    for _ in range(_STEPS):
        step = _solve(information, gradient, damping)
        if -gradient @ step < _NEGLIGIBLE:
            break
        moved = fit.moved(step)
        moved_cost = problem.cost(moved)
        if moved_cost < cost:
            fit, cost, damping = moved, moved_cost, max(damping / 10, 1e-9)
            information, gradient = problem.information_and_gradient(fit)
        else:
            damping *= 10
    return fit


def _jacobian(
    fit: _Fit, points3D_in_world: Points3D, pixels: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n 2 7"]:
    """Change of pixels: central differences through the lens, all else exact."""
    in_cam = fit.cam_from_world * points3D_in_world
    depths = in_cam[:, 2:]
    lens = np.empty((len(in_cam), 2, 3))
    for axis in (0, 1):
        offset = _STEP * depths * np.eye(3)[axis]
        ahead, behind = (np.asarray(fit.camera.img_from_cam(in_cam + o)) for o in (offset, -offset))
        lens[:, :, axis] = (ahead - behind) / (2 * _STEP * depths)
    # Pixels stay where they are when points move along their rays.
    lens[:, :, 2] = -np.einsum("nij,nj->ni", lens[:, :, :2], in_cam[:, :2] / depths)
    center = fit.camera.params[fit.camera.principal_point_idxs()]
    return np.concatenate([lens @ motions(in_cam), (pixels - center)[:, :, None]], axis=2)


def _squares(priors: tuple[Prior, ...], fit: _Fit) -> float:
    rows = [prior.rows(fit.cam_from_world, fit.camera) for prior in priors]
    return float(sum(np.sum(row.residuals**2) for row in rows))


def _scatter_px(errors: Float64[np.ndarray, " n"]) -> float:
    """Sigma of either coordinate, by the median, as if the seven unknowns had not fitted some of it away."""
    degrees = 2 * len(errors)
    return float(np.median(errors) / np.sqrt(2 * np.log(2)) * np.sqrt(degrees / max(degrees - 7, 1)))


def _solve(
    information: Float64[np.ndarray, "7 7"], gradient: Float64[np.ndarray, "7"], damping: float
) -> Float64[np.ndarray, "7"]:
    diagonal = np.diag(information)
    return np.linalg.solve(information + np.diag(damping * diagonal + (diagonal == 0)), -gradient)


def _inverse(information: Float64[np.ndarray, "7 7"]) -> Float64[np.ndarray, "7 7"]:
    """Covariance: zero for what is fixed, huge for what is left free."""
    diagonal = np.diag(information)
    scales = np.sqrt(np.where(diagonal > 0, diagonal, np.inf))
    correlation = information / np.outer(scales, scales) + np.diag(1e-12 + (diagonal == 0))
    return np.linalg.inv(correlation) / np.outer(scales, scales)
