"""The pose of a calibrated camera from 2D-3D matches."""

from dataclasses import dataclass

import numpy as np
import poselib
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Mask, Points2D, Points3D
from slimsfm.geometry import Box, motions

_MINIMAL = 3  # matches that P3P needs
_MIN_ITERATIONS = 30  # hypotheses; a low share of inliers asks for more by itself
_LEAST_SIGMA_PX = 0.5  # no detector places its keypoints more exactly


@dataclass(frozen=True, kw_only=True)
class RansacOptions:
    """How the robust pose search samples and scores its hypotheses."""

    max_error_px: float = 6.0
    """Largest reprojection error of an inlier."""

    min_inliers: int = 12
    """A pose with fewer inliers is no pose."""

    max_iterations: int = 10_000
    """Most hypotheses to try."""

    seed: int = 0
    """Seed of the sampler: equal inputs and seed give equal poses."""

    def __post_init__(self) -> None:
        if not self.max_error_px > 0:
            raise ValueError(f"max_error_px must be positive, got {self.max_error_px}")
        if self.min_inliers < _MINIMAL + 1:
            raise ValueError(f"min_inliers must be at least {_MINIMAL + 1}, got {self.min_inliers}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations must be at least 1, got {self.max_iterations}")


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseEstimate:
    """Where a camera stood, and the matches that say so."""

    cam_from_world: pycolmap.Rigid3d
    """The pose."""

    inliers: Mask
    """Which of the given matches agree with the pose."""

    covariance: Float64[np.ndarray, "6 6"] | None = None
    """Of the small motion in the camera's frame, a turn in radians and then a shift in map units, that leads
    from this pose to the true one, should the inliers be right; None where it was not computed."""

    confidence: float | None = None
    """Probability that the pose is right, its corner error below a tenth of the diagonal; None where nobody
    verified it."""

    @property
    def num_inliers(self) -> int:
        """How many matches agree with the pose."""
        return int(self.inliers.sum())

    def predicted_corner_error(self, box: Box) -> float:
        """The relative corner error to expect, should the inliers be right.

        The covariance is carried to the corners of the box; a corner counts with the root of its mean square
        distance, and the mean of all eight is taken over the diagonal.

        Raises:
            ValueError: The pose has no covariance.
        """
        if self.covariance is None:
            raise ValueError("covariance must be there to predict an error; estimate_pose computes it")
        moved = motions(self.cam_from_world * box.corners)
        squares = np.einsum("nia,ab,nib->n", moved, self.covariance, moved)
        return float(np.sqrt(np.maximum(squares, 0)).mean() / box.diagonal)


def estimate_pose(
    points2D: Points2D,
    points3D_in_world: Points3D,
    camera: pycolmap.Camera,
    options: RansacOptions = RansacOptions(),
) -> PoseEstimate | None:
    """Estimate where a calibrated camera stood from 2D-3D matches.

    P3P inside LO-RANSAC [1], then a robust refinement over the inliers. The lens distortion of any COLMAP
    camera model is taken out beforehand, so that one solver serves all of them.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map.
        camera: Intrinsics of the image; they are not refined.
        options: How to search.

    Returns:
        The pose, or None when no hypothesis has enough inliers.

    Raises:
        ValueError: The rows do not correspond, a coordinate is not finite, or the camera is spherical: it has
            no focal length, which the pinhole solver needs.

    References:
        [1] Chum, Matas and Kittler, Locally Optimized RANSAC, DAGM 2003.
    """
    check_matches(points2D, points3D_in_world)
    if camera.is_spherical():
        raise ValueError(f"camera must have a focal length, got the spherical model {camera.model_name}")
    if len(points2D) < options.min_inliers:
        return None
    pinhole_points2D = undistort(points2D, camera)
    usable = np.flatnonzero(np.isfinite(pinhole_points2D).all(axis=1))
    if len(usable) < options.min_inliers:
        return None
    pose, info = poselib.estimate_absolute_pose(
        pinhole_points2D[usable],
        points3D_in_world[usable],
        ideal_pinhole(camera),
        *_poselib_options(options),
    )
    inliers = np.zeros(len(points2D), dtype=bool)
    inliers[usable] = info["inliers"]
    if inliers.sum() < options.min_inliers:
        return None
    w, x, y, z = pose.q
    cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), pose.t)
    covariance = pose_covariance(
        pinhole_points2D[inliers], points3D_in_world[inliers], cam_from_world, camera.mean_focal_length()
    )
    return PoseEstimate(cam_from_world=cam_from_world, inliers=inliers, covariance=covariance)


def pose_covariance(
    pinhole_points2D: Points2D, points3D_in_world: Points3D, cam_from_world: pycolmap.Rigid3d, focal: float
) -> Float64[np.ndarray, "6 6"]:
    """How exactly matches fix a pose: the inverse of their information, times their own scatter.

    The scatter is that of the reprojection errors, yet no less than half a pixel. Where the matches leave a
    motion of the camera free, such as all of them on one line, its variance is huge.

    Args:
        pinhole_points2D: Pixels of an ideal pinhole camera, principal point (0, 0).
        points3D_in_world: What was matched with them.
        cam_from_world: The pose.
        focal: Focal length in pixels.
    """
    in_cam = cam_from_world * points3D_in_world
    x, y, z = in_cam.T
    zero = np.zeros_like(z)
    in_pixels = focal * np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]]).transpose(2, 0, 1)
    jacobian = (in_pixels @ motions(in_cam)).reshape(-1, 6)
    squares = np.sum((focal * in_cam[:, :2] / z[:, None] - pinhole_points2D) ** 2)
    variance = max(squares / max(2 * len(in_cam) - 6, 1), _LEAST_SIGMA_PX**2)
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    return variance * (vectors / np.maximum(values, 1e-12 * values[-1])) @ vectors.T


def check_matches(points2D: Points2D, points3D_in_world: Points3D) -> None:
    """Refuse points that do not correspond or are not finite.

    Raises:
        ValueError: They do not.
    """
    if len(points2D) != len(points3D_in_world):
        raise ValueError(
            f"points2D and points3D_in_world must match row by row, got {len(points2D)} and "
            f"{len(points3D_in_world)} rows"
        )
    for name, points in (("points2D", points2D), ("points3D_in_world", points3D_in_world)):
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise ValueError(f"{name} must be finite, got {points[bad[0]].tolist()} in row {bad[0]}")


def undistort(points2D: Points2D, camera: pycolmap.Camera) -> Points2D:
    """Pixels of a pinhole camera of equal focal length, principal point (0, 0); NaN behind the camera."""
    rays = np.asarray(camera.cam_from_img(points2D), dtype=np.float64).reshape(-1, 2)
    return camera.mean_focal_length() * rays


def ideal_pinhole(camera: pycolmap.Camera) -> dict:
    """The camera of undistorted pixels, as poselib wants it."""
    focal = camera.mean_focal_length()
    return {
        "model": "SIMPLE_PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [focal, 0.0, 0.0],
    }


def _poselib_options(options: RansacOptions) -> tuple[dict, dict]:
    ransac = {
        "max_reproj_error": options.max_error_px,
        "max_iterations": options.max_iterations,
        "min_iterations": min(_MIN_ITERATIONS, options.max_iterations),
        "seed": options.seed,
    }
    return ransac, {"loss_type": "CAUCHY"}
