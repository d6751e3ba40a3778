"""Refine a pose, and if asked the focal length, by reprojection errors and priors."""

from dataclasses import dataclass, replace

import numpy as np
import poselib
import pycolmap
from jaxtyping import Bool, Float64

from slimsfm.arrays import Mask, Points2D, Points3D
from slimsfm.geometry import motions, project, reprojection_errors
from slimsfm.pose.priors import FOCAL, UNKNOWNS, FocalPrior, FramePrior, Gravity, Prior, with_focal_length
from slimsfm.pose.ransac import PinholeMatches, from_poselib, to_poselib
from slimsfm.pose.scatter import CAUCHY, EXACT_PX, MINIMAL, median_sigma, refine_to_scatter
from slimsfm.pose.types import MIN_SIGMA_PX, PoseEstimate, pose_covariance

_ROUNDS = 8  # of choosing inliers; 2 to 4 are common
_STEPS = 30  # of Levenberg-Marquardt per round; 5 are common
_NEGLIGIBLE = 1e-6  # decrease of the cost that ends a round: a thousandth of a sigma
_FARTHEST = 0.5  # change of an intrinsic per step
_STEP = 1e-6  # of the numerical derivative of the lens, relative to depth


def refine_pose(
    points2D: Points2D,
    points3D_in_world: Points3D,
    start_cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    *,
    max_error_px: float,
    focal: FocalPrior | None = None,
    frame: FramePrior | None = None,
    gravity: Gravity | None = None,
) -> PoseEstimate:
    """Refine a pose by minimizing reprojection errors under a Cauchy loss.

    Without priors, PoseLib minimizes the errors of all matches on undistorted pixels, and the inliers are
    those of the result. With priors, a round minimizes the errors of the inliers in the distorted image plus
    the squared residuals of the priors, by the method of Levenberg and Marquardt, and rounds alternate with
    choosing the inliers. Errors are measured in sigmas, the scatter that the last round left. So a prior has
    its due weight: hardly any where the matches determine the pose, all of it in a direction that they leave
    free. A focal length beyond the limits of its prior is set to the limit.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map.
        start_cam_from_world: Approximate pose to start from.
        camera: Intrinsics of the image, of any model that has a focal length.
        max_error_px: Largest reprojection error of an inlier; at first, three sigmas.
        focal: Refine the focal length too, starting from the camera's; two focal lengths keep their ratio.
        frame: Refine the principal point or the aspect ratio of the pixels too, or both.
        gravity: Direction of gravity.

    Returns:
        The pose, whatever its quality: check its inliers. It has no covariance if fewer than 4 matches agree.
    """
    if focal is None and frame is None and gravity is None:
        return _refine_by_matches(points2D, points3D_in_world, start_cam_from_world, camera, max_error_px)
    priors = tuple(prior for prior in (focal, frame, gravity) if prior is not None)
    problem = _Problem(
        pixels=points2D,
        in_world=points3D_in_world,
        sigma_px=max_error_px / 3,
        priors=priors,
        free=_free(focal, frame),
    )
    start = _Fit(cam_from_world=start_cam_from_world, camera=camera)
    found = _refine_in_rounds(problem, start, max_error_px)
    if focal is None:
        found = replace(found, relative_focal_sigma=None)
        return found if frame else replace(found, camera=None)
    if found.camera is None or found.covariance is None:
        return found
    focal_px = found.camera.mean_focal_length()
    limited_px = float(np.clip(focal_px, *focal.limits_px))
    if limited_px == focal_px:
        return found
    at_limit = replace(start, camera=with_focal_length(camera, limited_px))
    return _refine_in_rounds(replace(problem, free=_free(None, frame)), at_limit, max_error_px)


def _free(focal: FocalPrior | None, frame: FramePrior | None) -> Bool[np.ndarray, "10"]:
    """Which unknowns are free."""
    center, aspect = (frame.center, frame.aspect) if frame else (False, False)
    return np.array([*6 * (True,), focal is not None, center, center, aspect])


def _refine_by_matches(
    points2D: Points2D,
    points3D_in_world: Points3D,
    start_cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    max_error_px: float,
) -> PoseEstimate:
    matches = PinholeMatches.of(points2D, points3D_in_world, camera)
    found, _ = poselib.refine_absolute_pose(  # of all matches: the start may be far off
        matches.pixels,
        matches.in_world,
        to_poselib(start_cam_from_world),
        matches.pinhole,
        {"loss_type": "CAUCHY", "loss_scale": max_error_px / 3},
    )
    cam_from_world = refine_to_scatter(matches, from_poselib(found), max_error_px)
    inliers = reprojection_errors(points2D, points3D_in_world, cam_from_world, camera) <= max_error_px
    agree = inliers[matches.rows]
    covariance = None
    if agree.sum() >= MINIMAL:
        covariance = pose_covariance(
            matches.pixels[agree], matches.in_world[agree], cam_from_world, matches.focal_px
        )
    return PoseEstimate(cam_from_world=cam_from_world, inliers=inliers, covariance=covariance)


def _refine_in_rounds(problem: "_Problem", fit: "_Fit", max_error_px: float) -> PoseEstimate:
    """Alternate between choosing the inliers and minimizing their errors."""
    errors = fit.errors(problem.pixels, problem.in_world)
    for last in range(_ROUNDS):
        inliers = errors < max_error_px
        if inliers.sum() < MINIMAL:
            return PoseEstimate(cam_from_world=fit.cam_from_world, inliers=inliers, camera=fit.camera)
        fit = _minimize(problem.of(inliers), fit)
        errors = fit.errors(problem.pixels, problem.in_world)
        sigma_px = float(np.clip(_scatter_px(errors[inliers]), EXACT_PX, max_error_px / 3))
        problem = replace(problem, sigma_px=sigma_px)
        if last and np.array_equal(inliers, errors < max_error_px):
            break
    return _estimate(problem, fit, errors < max_error_px)


def _estimate(problem: "_Problem", fit: "_Fit", inliers: Mask) -> PoseEstimate:
    seen = replace(problem.of(inliers), sigma_px=max(problem.sigma_px, MIN_SIGMA_PX))
    covariance = _inverse(seen.information_and_gradient(fit)[0])
    return PoseEstimate(
        cam_from_world=fit.cam_from_world,
        inliers=inliers,
        covariance=covariance[:6, :6],
        camera=fit.camera,
        relative_focal_sigma=float(covariance[FOCAL, FOCAL] ** 0.5),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    cam_from_world: pycolmap.Rigid3d
    camera: pycolmap.Camera

    def moved(self, step: Float64[np.ndarray, "10"]) -> "_Fit":
        motion = pycolmap.Rigid3d(pycolmap.Rotation3d(step[:3]), step[3:6])
        return _Fit(cam_from_world=motion * self.cam_from_world, camera=_changed(self.camera, step[FOCAL:]))

    def errors(self, points2D: Points2D, points3D_in_world: Points3D) -> Float64[np.ndarray, " n"]:
        return reprojection_errors(points2D, points3D_in_world, self.cam_from_world, self.camera)

    def jacobian(
        self, points3D_in_world: Points3D, pixels: Float64[np.ndarray, "n 2"]
    ) -> Float64[np.ndarray, "n 2 10"]:
        """`projection_jacobian` with distortion, and the change with the logarithm of the focal length.

        The derivative of the lens is taken by central differences; the rest is exact.
        """
        in_cam = self.cam_from_world * points3D_in_world
        depths = in_cam[:, 2:]
        lens = np.empty((len(in_cam), 2, 3))
        for axis in (0, 1):
            offset = _STEP * depths * np.eye(3)[axis]
            ahead, behind = (np.asarray(self.camera.img_from_cam(in_cam + o)) for o in (offset, -offset))
            lens[:, :, axis] = (ahead - behind) / (2 * _STEP * depths)
        # a point that moves along its ray does not move in the image
        lens[:, :, 2] = -np.einsum("nij,nj->ni", lens[:, :, :2], in_cam[:, :2] / depths)
        center = self.camera.params[self.camera.principal_point_idxs()]
        from_center = pixels - center
        shift = np.tile(self.camera.mean_focal_length() * np.eye(2), (len(in_cam), 1, 1))
        stretch = from_center * (0.5, -0.5)
        return np.concatenate(
            [lens @ motions(in_cam), from_center[:, :, None], shift, stretch[:, :, None]], axis=2
        )


def _changed(camera: pycolmap.Camera, step: Float64[np.ndarray, "4"]) -> pycolmap.Camera:
    """The camera with its intrinsics moved by a step: focal length, principal point, aspect ratio."""
    if not step.any():
        return camera
    focal, x, y, aspect = np.clip(step, -_FARTHEST, _FARTHEST)
    changed = with_focal_length(camera, camera.mean_focal_length() * np.exp(focal))
    params = changed.params.copy()
    params[camera.principal_point_idxs()] += camera.mean_focal_length() * np.array([x, y])
    if aspect:
        params[camera.focal_length_idxs()] *= np.exp([aspect / 2, -aspect / 2])
    changed.params = params.tolist()
    return changed


@dataclass(frozen=True, kw_only=True, eq=False)
class _Problem:
    pixels: Points2D
    in_world: Points3D
    sigma_px: float
    priors: tuple[Prior, ...]
    free: Bool[np.ndarray, "10"]

    def of(self, inliers: Mask) -> "_Problem":
        return replace(self, pixels=self.pixels[inliers], in_world=self.in_world[inliers])

    def cost(self, fit: _Fit) -> float:
        squares = (fit.errors(self.pixels, self.in_world) / self.sigma_px) ** 2
        return float(CAUCHY**2 * np.log1p(squares / CAUCHY**2).sum() + _squares(self.priors, fit))

    def information_and_gradient(
        self, fit: _Fit
    ) -> tuple[Float64[np.ndarray, "10 10"], Float64[np.ndarray, "10"]]:
        seen = project(self.in_world, fit.cam_from_world, fit.camera)
        residuals = (seen - self.pixels) / self.sigma_px
        jacobian = fit.jacobian(self.in_world, seen) / self.sigma_px
        weights = 1 / (1 + np.sum(residuals**2, axis=1) / CAUCHY**2)
        weighted = (weights[:, None, None] * jacobian).reshape(-1, UNKNOWNS)
        information = weighted.T @ jacobian.reshape(-1, UNKNOWNS)
        gradient = weighted.T @ residuals.ravel()
        for prior in self.priors:
            rows = prior.rows(fit.cam_from_world, fit.camera)
            information += rows.jacobian.T @ rows.jacobian
            gradient += rows.jacobian.T @ rows.residuals
        information[~self.free], information[:, ~self.free], gradient[~self.free] = 0, 0, 0
        return information, gradient


def _minimize(problem: _Problem, fit: _Fit) -> _Fit:
    damping, cost = 1e-3, problem.cost(fit)
    information, gradient = problem.information_and_gradient(fit)
    for _ in range(_STEPS):
        step = _solve(information, gradient, damping)
        if not -gradient @ step >= _NEGLIGIBLE:  # nor for a step that is no number
            break
        moved = fit.moved(step)
        moved_cost = problem.cost(moved)
        if moved_cost < cost:
            fit, cost, damping = moved, moved_cost, max(damping / 10, 1e-9)
            information, gradient = problem.information_and_gradient(fit)
        else:
            damping *= 10
    return fit


def _squares(priors: tuple[Prior, ...], fit: _Fit) -> float:
    rows = [prior.rows(fit.cam_from_world, fit.camera) for prior in priors]
    return float(sum(np.sum(row.residuals**2) for row in rows))


def _scatter_px(errors: Float64[np.ndarray, " n"]) -> float:
    """Sigma of each coordinate from the median error, corrected for the seven unknowns that were fitted."""
    degrees = 2 * len(errors)
    return float(median_sigma(errors) * np.sqrt(degrees / max(degrees - 7, 1)))


def _solve(
    information: Float64[np.ndarray, "10 10"], gradient: Float64[np.ndarray, "10"], damping: float
) -> Float64[np.ndarray, "10"]:
    diagonal = np.diag(information)
    return np.linalg.solve(information + np.diag(damping * diagonal + (diagonal == 0)), -gradient)


def _inverse(information: Float64[np.ndarray, "10 10"]) -> Float64[np.ndarray, "10 10"]:
    """Covariance: zero for what is fixed, huge for what the matches leave free."""
    diagonal = np.diag(information)
    scales = np.sqrt(np.where(diagonal > 0, diagonal, np.inf))
    correlation = information / np.outer(scales, scales) + np.diag(1e-12 + (diagonal == 0))
    return np.linalg.inv(correlation) / np.outer(scales, scales)
