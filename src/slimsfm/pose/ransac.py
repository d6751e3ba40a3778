"""The robust search of a pose with PoseLib: an ideal pinhole camera, conversion of poses, and RANSAC."""

from dataclasses import dataclass
from math import ceil, log, log1p

import numpy as np
import poselib
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.arrays import Ids, Points2D, Points3D
from slimsfm.pose.priors import Gravity


def check_matches(points2D: Points2D, points3D_in_world: Points3D) -> None:
    """Check that points correspond row by row and are finite.

    Raises:
        ValueError: The numbers of rows differ, or a coordinate is not finite.
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


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeMatches:
    """Matches of the ideal pinhole camera that has the focal length of a given camera."""

    rows: Ids
    """Rows of the given matches; pixels that no ray in front of the camera reaches are left out."""

    pixels: Points2D
    """Undistorted pixels; the principal point is (0, 0)."""

    in_world: Points3D
    """The point matched with each pixel."""

    pinhole: dict
    """PoseLib's description of the ideal camera."""

    @classmethod
    def of(cls, points2D: Points2D, points3D_in_world: Points3D, camera: pycolmap.Camera) -> "PinholeMatches":
        """Undistort the pixels of matches."""
        focal_px = camera.mean_focal_length()
        pixels = focal_px * np.asarray(camera.cam_from_img(points2D), dtype=np.float64).reshape(-1, 2)
        rows = np.flatnonzero(np.isfinite(pixels).all(axis=1))
        return cls(
            rows=rows,
            pixels=pixels[rows],
            in_world=points3D_in_world[rows],
            pinhole={
                "model": "SIMPLE_PINHOLE",
                "width": camera.width,
                "height": camera.height,
                "params": [focal_px, 0.0, 0.0],
            },
        )

    @property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return self.pinhole["params"][0]

    def errors(self, cam_from_world: pycolmap.Rigid3d) -> Float64[np.ndarray, " n"]:
        """Reprojection errors in pixels; infinite behind the camera."""
        x, y, z = (cam_from_world * self.in_world).T
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            scale = self.focal_px / z
            errors = np.hypot(scale * x - self.pixels[:, 0], scale * y - self.pixels[:, 1])
        errors[~(z > 0)] = np.inf
        return errors


def to_poselib(cam_from_world: pycolmap.Rigid3d) -> poselib.CameraPose:
    """Convert a pose to PoseLib, whose quaternions begin with w."""
    x, y, z, w = cam_from_world.rotation.quat
    pose = poselib.CameraPose()
    pose.q, pose.t = np.array([w, x, y, z]), cam_from_world.translation
    return pose


def from_poselib(pose: poselib.CameraPose) -> pycolmap.Rigid3d:
    """Convert a pose from PoseLib."""
    w, x, y, z = pose.q
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), pose.t)


P3P_SAMPLE = 3
"""Matches that P3P needs."""

_UPRIGHT_SAMPLE = 2  # matches that the upright solver needs
_MIN_ITERATIONS = 30  # hypotheses; PoseLib tries more by itself where the share of inliers is low
_MISSED = 1e-4  # probability that the search misses a pose
_CAUTION = 3  # times more hypotheses, because not every sample of inliers gives a good one
_MIN_SHARE = 1e-3  # of inliers that is worth a search
_BATCH = 100  # hypotheses scored together
_REACH = 2  # standard deviations of gravity by which the errors of a hypothesis may grow


@dataclass(frozen=True, kw_only=True)
class RansacOptions:
    """How the robust pose search samples and scores its hypotheses."""

    max_error_px: float = 6.0
    """Largest reprojection error of an inlier."""

    min_inliers: int = 12
    """Fewest inliers of a pose."""

    max_iterations: int = 10_000
    """Most hypotheses to try."""

    seed: int = 0
    """Seed of the sampler: equal inputs and seed give equal poses."""

    def __post_init__(self) -> None:
        if not self.max_error_px > 0:
            raise ValueError(f"max_error_px must be positive, got {self.max_error_px}")
        if self.min_inliers < P3P_SAMPLE + 1:
            raise ValueError(f"min_inliers must be at least {P3P_SAMPLE + 1}, got {self.min_inliers}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations must be at least 1, got {self.max_iterations}")


def hypotheses_to_try(inlier_share: float, sample_size: int) -> int:
    """Number of random samples among which one without a wrong match is almost certain.

    As in PoseLib, three times the number that a probability of 1e-4 of missing it asks for.

    Args:
        inlier_share: Share of inliers among the matches.
        sample_size: Matches per sample.
    """
    share = min(max(inlier_share, _MIN_SHARE), 1 - _MIN_SHARE)
    return ceil(_CAUTION * log(_MISSED) / log1p(-(share**sample_size)))


def search_p3p(
    matches: PinholeMatches, options: RansacOptions
) -> tuple[pycolmap.Rigid3d, Int64[np.ndarray, " inliers"]]:
    """Find the pose by PoseLib's P3P inside LO-RANSAC, refined over its inliers, and the inliers' rows."""
    pose, info = poselib.estimate_absolute_pose(
        matches.pixels,
        matches.in_world,
        matches.pinhole,
        {
            "max_reproj_error": options.max_error_px,
            "max_iterations": options.max_iterations,
            "min_iterations": min(_MIN_ITERATIONS, options.max_iterations),
            "seed": options.seed,
        },
        {"loss_type": "CAUCHY"},
    )
    return from_poselib(pose), np.flatnonzero(info["inliers"])


def search_upright(
    matches: PinholeMatches, gravity: Gravity, options: RansacOptions
) -> pycolmap.Rigid3d | None:
    """Find the pose of least truncated squared errors among hypotheses of exactly this gravity.

    Local optimization is free to leave gravity. The errors of a hypothesis may exceed those of an inlier by
    what the uncertainty of gravity causes. None where no sample gives a finite pose.
    """
    rng = np.random.default_rng(options.seed)
    upright = _Upright.of(matches, gravity)
    most = _max_squared_error(matches, gravity, options.max_error_px)
    best, least, tried, enough = None, np.inf, 0, options.max_iterations
    while tried < enough:
        size = min(_BATCH, enough - tried)
        tried += size
        poses = upright.poses(_pairs(rng, len(matches.pixels), size))
        if not len(poses):
            continue
        costs = np.minimum(_squared_errors(matches, poses), most).sum(axis=1)
        hypothesis = poses.row(int(np.argmin(costs)))
        for pose in (hypothesis, _optimized(hypothesis, matches, most)):
            squares = _squared_errors(matches, pose)[0]
            cost = np.minimum(squares, most).sum()
            if cost < least:
                best, least = pose, cost
                enough = min(enough, hypotheses_to_try(float(np.mean(squares < most)), _UPRIGHT_SAMPLE))
    if best is None:
        return None
    return pycolmap.Rigid3d(pycolmap.Rotation3d(best.rotations[0]), best.translations[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Poses:
    """Poses as matrices, which many matches are projected with at once."""

    rotations: Float64[np.ndarray, "k 3 3"]
    translations: Float64[np.ndarray, "k 3"]

    def __len__(self) -> int:
        return len(self.rotations)

    def row(self, index: int) -> "_Poses":
        return _Poses(
            rotations=self.rotations[index : index + 1], translations=self.translations[index : index + 1]
        )


def _squared_errors(matches: PinholeMatches, poses: _Poses) -> Float64[np.ndarray, "k n"]:
    """In pixels; infinite behind the camera."""
    x, y, z = (
        poses.rotations[:, axis] @ matches.in_world.T + poses.translations[:, axis, None] for axis in range(3)
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        scale = matches.focal_px / z
        squares = (scale * x - matches.pixels[:, 0]) ** 2 + (scale * y - matches.pixels[:, 1]) ** 2
    squares[~(z > 0)] = np.inf
    return squares


@dataclass(frozen=True, kw_only=True, eq=False)
class _Upright:
    """PoseLib's upright solver: it expects gravity along the y axes of both camera and world."""

    from_cam: Float64[np.ndarray, "3 3"]
    from_world: Float64[np.ndarray, "3 3"]
    rays: Float64[np.ndarray, "n 3"]
    points: Points3D

    @classmethod
    def of(cls, matches: PinholeMatches, gravity: Gravity) -> "_Upright":
        from_cam, from_world = _to_y_axis(gravity.in_cam), _to_y_axis(gravity.in_world)
        rays = np.column_stack([matches.pixels / matches.focal_px, np.ones(len(matches.pixels))])
        return cls(
            from_cam=from_cam,
            from_world=from_world,
            rays=rays / np.linalg.norm(rays, axis=1, keepdims=True) @ from_cam.T,
            points=matches.in_world @ from_world.T,
        )

    def poses(self, pairs: Int64[np.ndarray, "m 2"]) -> _Poses:
        """Up to two poses per pair of matches."""
        pairs_of = zip(self.rays[pairs], self.points[pairs], strict=True)
        solved = [pose for rays, points in pairs_of for pose in poselib.up2p(rays, points)]
        rotations = np.array([pose.R for pose in solved]).reshape(-1, 3, 3)
        translations = np.array([pose.t for pose in solved]).reshape(-1, 3)
        finite = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(translations).all(axis=1)
        return _Poses(
            rotations=self.from_cam.T @ rotations[finite] @ self.from_world,
            translations=translations[finite] @ self.from_cam,
        )


def _pairs(rng: np.random.Generator, count: int, size: int) -> Int64[np.ndarray, "{size} 2"]:
    """Pairs of two different matches."""
    first = rng.integers(count, size=size)
    return np.stack([first, (first + rng.integers(1, count, size=size)) % count], axis=1)


def _optimized(pose: _Poses, matches: PinholeMatches, most: float) -> _Poses:
    """The optimum for the inliers, of any gravity: many matches show how wrong the measured one is."""
    inliers = _squared_errors(matches, pose)[0] < most
    start = poselib.CameraPose()
    start.R, start.t = pose.rotations[0], pose.translations[0]
    found, _ = poselib.refine_absolute_pose(
        matches.pixels[inliers],
        matches.in_world[inliers],
        start,
        matches.pinhole,
        {"loss_type": "CAUCHY", "loss_scale": float(np.sqrt(most)) / 2},
    )
    return _Poses(rotations=found.R[None], translations=found.t[None])


def _max_squared_error(matches: PinholeMatches, gravity: Gravity, max_error_px: float) -> float:
    """Largest squared error of an inlier: its own, plus that of a rotation by the uncertainty of gravity."""
    spread_px = np.sqrt(np.sum(np.var(matches.pixels, axis=0)))
    return float(max_error_px**2 + (_REACH * np.radians(gravity.uncertainty_deg) * spread_px) ** 2)


def _to_y_axis(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """A rotation that turns a direction onto (0, 1, 0)."""
    y = direction / np.linalg.norm(direction)
    x = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
    x = x / np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)])
