"""Whether the intrinsics of an image agree with its matches, and the estimation of those that do not.

A wrong focal length, a crop or stretched pixels leave a pattern in the reprojection errors that no motion of
the camera explains. One step of Gauss and Newton from the pose that was found gives the change of each of the
intrinsics that would explain it, and by how much the squared errors would decrease.
"""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points2D, Points3D
from slimsfm.geometry import reprojection_errors
from slimsfm.pose.estimation import estimate_pose
from slimsfm.pose.priors import (
    ASPECT,
    CENTER,
    FOCAL,
    UNKNOWNS,
    FocalPrior,
    FramePrior,
    Gravity,
    with_two_focal_lengths,
)
from slimsfm.pose.ransac import PinholeMatches, RansacOptions
from slimsfm.pose.refinement import CAUCHY, median_sigma, refine_pose
from slimsfm.pose.types import MIN_SIGMA_PX, CameraCheck, PoseEstimate, projection_jacobian

_NEAR = 2.5  # times the largest error of an inlier: a right match of a wrong camera may be that far off
_SHARPEST_PX = 0.3  # smallest sigma that a check assumes
_DECREASES = {"focal length": 10.0, "principal point": 14.0, "pixel aspect ratio": 13.0}  # that convince
_CHANGES = {"focal length": 0.03, "principal point": 0.05, "pixel aspect ratio": 0.04}  # beyond autofocus
# and optical stabilization, which shift a phone's principal point by up to 0.03 focal lengths
_PLACES = {
    "focal length": [0],
    "principal point": [1, 2],
    "pixel aspect ratio": [3],
}  # among the intrinsics
_FAR = 0.15  # change of the focal length from which it is searched for
_FEW = 0.5  # share of inliers below which the focal length is searched for
_UNKNOWN = np.array([0.3, 0.1, 0.1, 0.1]) ** -2.0  # information on the intrinsics of any image
_LEAST = 8  # matches that a check needs

FOCAL_LENGTH, PRINCIPAL_POINT, ASPECT_RATIO = _PLACES
"""Names of the intrinsics that may be estimated."""


def misfit(check: CameraCheck, free: tuple[str, ...] = ()) -> float:
    """How much matches contradict those of the intrinsics that are not free; from 1 on, one is set free."""
    return max(_misfits(check, free).values(), default=0.0)


def _misfits(check: CameraCheck, free: tuple[str, ...]) -> dict[str, float]:
    return {
        name: check.decreases[name] / _DECREASES[name]
        for name in _PLACES
        if name not in free and check.changes[name] > _CHANGES[name]
    }


def check_camera(
    points2D: Points2D,
    points3D_in_world: Points3D,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
    free: tuple[str, ...] = (),
) -> CameraCheck:
    """Compare the intrinsics of an image with its matches.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map; all project into the image.
        cam_from_world: The pose that minimizes their errors.
        camera: The intrinsics.
        free: Names of the intrinsics that were estimated with the pose.
    """
    information, gradient = _information(points2D, points3D_in_world, cam_from_world, camera)
    around = np.column_stack([information[:FOCAL, FOCAL:], gradient[:FOCAL]])
    motions = -np.linalg.solve(information[:FOCAL, :FOCAL], around)
    reduced = np.column_stack([information[FOCAL:, FOCAL:], gradient[FOCAL:]])
    reduced += information[FOCAL:, :FOCAL] @ motions  # of the intrinsics alone, with the pose that fits best
    unsure = np.linalg.inv(reduced[:, :-1] + np.diag(_UNKNOWN))
    shift = unsure @ reduced[:, -1:]
    decreases, changes = {}, {}
    for name, places in _PLACES.items():
        others = reduced
        for other in free if name == FOCAL_LENGTH else dict.fromkeys([FOCAL_LENGTH, *free]):
            others = others if other == name else _eliminated(others, _PLACES[other])
        own = others[places]
        step = np.linalg.solve(own[:, places], own[:, -1])
        decreases[name], changes[name] = float(own[:, -1] @ step), float(np.sqrt(step @ step))
    return CameraCheck(
        decreases=decreases,
        changes=changes,
        growth=motions[:, :-1] @ (unsure + shift @ shift.T) @ motions[:, :-1].T,
    )


def _eliminated(equations: Float64[np.ndarray, "4 5"], places: list[int]) -> Float64[np.ndarray, "4 5"]:
    """Normal equations of the other intrinsics, with those at some places as they fit best."""
    own = equations[places]
    left = equations - equations[:, places] @ np.linalg.solve(own[:, places], own)
    left[places] = own
    return left


def _information(
    points2D: Points2D, points3D_in_world: Points3D, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera
) -> tuple[Float64[np.ndarray, "10 10"], Float64[np.ndarray, "10"]]:
    """Normal equations of the ideal pinhole camera, in sigmas, under a Cauchy loss."""
    matches = PinholeMatches.of(points2D, points3D_in_world, camera)
    in_cam = cam_from_world * matches.in_world
    seen = matches.focal_px * in_cam[:, :2] / in_cam[:, 2:]
    residuals = seen - matches.pixels
    errors = np.linalg.norm(residuals, axis=1)
    sigma = max(median_sigma(errors), _SHARPEST_PX)
    jacobian = np.empty((len(seen), 2, UNKNOWNS))
    jacobian[:, :, :FOCAL] = projection_jacobian(in_cam, matches.focal_px)
    jacobian[:, :, FOCAL] = seen
    jacobian[:, :, CENTER] = matches.focal_px * np.eye(2)
    jacobian[:, :, ASPECT] = seen * (0.5, -0.5)
    weights = 1 / (1 + (errors / (sigma * CAUCHY)) ** 2)
    rows = jacobian.reshape(-1, UNKNOWNS) / sigma
    weighted = (np.repeat(weights, 2)[:, None] * rows).T
    information = weighted @ rows
    return information + 1e-12 * np.diag(np.diag(information)), weighted @ (residuals.ravel() / sigma)


def with_check(
    points2D: Points2D,
    points3D_in_world: Points3D,
    found: PoseEstimate,
    camera: pycolmap.Camera,
    options: RansacOptions = RansacOptions(),
) -> PoseEstimate:
    """Check the intrinsics that a pose was estimated with, and keep them; arguments as in `fit_camera`."""
    return _CameraSearch(points2D, points3D_in_world, camera, options).checked(found)


def fit_camera(
    points2D: Points2D,
    points3D_in_world: Points3D,
    found: PoseEstimate,
    camera: pycolmap.Camera,
    options: RansacOptions = RansacOptions(),
    *,
    focal: FocalPrior | None = None,
    gravity: Gravity | None = None,
) -> PoseEstimate:
    """Check the intrinsics that a pose was estimated with, and estimate those that the matches contradict.

    One after the other, the focal length, then principal point or aspect ratio, whichever the matches
    contradict most, is set free, as long as the errors decrease significantly. Where the focal length is far
    off, or few matches agree, poses are searched at many focal lengths.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map.
        found: The pose that was estimated from these matches.
        camera: The intrinsics that it was estimated with.
        options: How it was estimated.
        focal: The prior with which the focal length was estimated; None if it was taken as known.
        gravity: The direction of gravity with which it was estimated.

    Returns:
        The pose with its `check`; with another `camera` and `estimated` if intrinsics were contradicted.
    """
    search = _CameraSearch(points2D, points3D_in_world, camera, options, focal, gravity)
    best = search.checked(found)
    while best.check and misfit(best.check, best.estimated) > 1:
        misfits = _misfits(best.check, best.estimated)
        better = search.freed(best, max(misfits, key=misfits.__getitem__))
        if better is None:
            break
        best = search.checked(better)
    return best


@dataclass(frozen=True, eq=False)
class _CameraSearch:
    points2D: Points2D
    points3D_in_world: Points3D
    camera: pycolmap.Camera
    options: RansacOptions
    focal: FocalPrior | None = None
    gravity: Gravity | None = None

    def checked(self, pose: PoseEstimate) -> PoseEstimate:
        camera = pose.camera or self.camera
        near = self._errors(pose) < _NEAR * self.options.max_error_px
        if near.sum() < _LEAST:
            return pose
        check = check_camera(
            self.points2D[near], self.points3D_in_world[near], pose.cam_from_world, camera, pose.estimated
        )
        return replace(pose, check=check)

    def freed(self, pose: PoseEstimate, name: str) -> PoseEstimate | None:
        """The pose with one more of the intrinsics estimated; None if the errors hardly decrease."""
        estimated = tuple(dict.fromkeys([*pose.estimated, FOCAL_LENGTH, name]))
        tried = [self._refined(pose, estimated)]
        if name == FOCAL_LENGTH and self._is_far(pose):
            tried.append(self._searched())
        gains = [-np.inf if one is None else self._gain(pose, one) for one in tried]
        best = int(np.argmax(gains))
        return tried[best] if gains[best] > _DECREASES[name] else None

    def _is_far(self, pose: PoseEstimate) -> bool:
        change = pose.check.changes[FOCAL_LENGTH] if pose.check else 0.0
        return change > _FAR or pose.num_inliers < _FEW * len(self.points2D)

    def _refined(self, pose: PoseEstimate, estimated: tuple[str, ...]) -> PoseEstimate | None:
        """Refine from this pose: first with all matches that are near, then with its inliers."""
        center, aspect = PRINCIPAL_POINT in estimated, ASPECT_RATIO in estimated
        camera, frame = pose.camera or self.camera, None
        if aspect:
            camera = with_two_focal_lengths(camera)
        if camera is None:
            return None
        if center or aspect:
            frame = FramePrior(camera=self.camera, center=center, aspect=aspect)
        prior, start = self.focal or FocalPrior.of(self.camera), pose.cam_from_world
        one = pose
        for factor in (_NEAR, 1.0):
            one = refine_pose(
                self.points2D,
                self.points3D_in_world,
                start,
                camera,
                max_error_px=factor * self.options.max_error_px,
                focal=prior,
                frame=frame,
                gravity=self.gravity,
            )
            start, camera = one.cam_from_world, one.camera or camera
        enough = one.covariance is not None and one.num_inliers >= self.options.min_inliers
        return replace(one, estimated=estimated) if enough else None

    def _searched(self) -> PoseEstimate | None:
        prior = FocalPrior.of(self.camera)
        one = estimate_pose(
            self.points2D,
            self.points3D_in_world,
            self.camera,
            self.options,
            focal=prior,
            gravity=self.gravity,
        )
        return one and replace(one, estimated=(FOCAL_LENGTH,))

    def _gain(self, before: PoseEstimate, after: PoseEstimate) -> float:
        """By how much the squared errors decrease, in sigmas of the second pose; each is limited."""
        errors = [np.minimum(self._errors(one), self.options.max_error_px) for one in (before, after)]
        sigma_px = max(median_sigma(errors[1][after.inliers]), MIN_SIGMA_PX)
        return float(np.sum(errors[0] ** 2 - errors[1] ** 2) / sigma_px**2)

    def _errors(self, pose: PoseEstimate) -> Float64[np.ndarray, " n"]:
        camera = pose.camera or self.camera
        return reprojection_errors(self.points2D, self.points3D_in_world, pose.cam_from_world, camera)
