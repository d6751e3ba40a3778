"""The pose of a calibrated camera that knows which way is down."""

from dataclasses import dataclass

import numpy as np
import poselib
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.arrays import Points2D, Points3D
from slimsfm.geometry import motions
from slimsfm.pose import PoseEstimate, RansacOptions, check_matches, ideal_pinhole, undistort
from slimsfm.ransac import hypotheses_to_try
from slimsfm.refinement import PriorRows, refine

_BATCH = 100  # hypotheses scored together
_SAMPLE = 2  # matches that the upright solver needs
_REACH = 2  # standard deviations of gravity that the errors of a hypothesis are forgiven
_MOST_SIGMAS = 4  # that a pose may leave gravity by; one in 3000 does


@dataclass(frozen=True, kw_only=True, eq=False)
class Gravity:
    """Which way is down in the map, and down for the camera, as its accelerometer tells; of any length."""

    in_world: Float64[np.ndarray, "3"]
    """Direction in the frame of the map."""

    in_cam: Float64[np.ndarray, "3"]
    """Direction in the frame of the camera: x to the right of the upright image, y down, z forward."""

    uncertainty_deg: float = 2.0
    """Standard deviation, about either horizontal axis, of the angle between the two."""

    def __post_init__(self) -> None:
        for name, direction in (("in_world", self.in_world), ("in_cam", self.in_cam)):
            if not np.all(np.isfinite(direction)) or not np.any(direction):
                raise ValueError(f"{name} must be finite and not zero, got {direction.tolist()}")
        if not 0 < self.uncertainty_deg < 90:
            raise ValueError(f"uncertainty_deg must be between 0 and 90, got {self.uncertainty_deg}")

    def rows(self, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> PriorRows:  # noqa: ARG002
        """Gravity as a prior: the direction that the pose makes of the map's, less the camera's."""
        sigma = np.radians(self.uncertainty_deg)
        down = cam_from_world.rotation.matrix() @ _unit(self.in_world)
        jacobian = np.zeros((3, 7))
        jacobian[:, :3] = motions(down[None])[0, :, :3]
        return PriorRows(residuals=(down - _unit(self.in_cam)) / sigma, jacobian=jacobian / sigma)


def estimate_upright_pose(
    points2D: Points2D,
    points3D_in_world: Points3D,
    camera: pycolmap.Camera,
    gravity: Gravity,
    options: RansacOptions = RansacOptions(),
) -> PoseEstimate | None:
    """Estimate where a calibrated camera stood from 2D-3D matches and the direction of gravity.

    Gravity leaves four unknowns, for which two matches suffice [1]: where one match in ten is right, one
    hypothesis in a hundred is good, and with three matches one in a thousand. Hypotheses have exactly this
    gravity, so LO-RANSAC forgives them the errors that its uncertainty causes. The refinement that follows
    has all six unknowns and gravity as a prior. A pose that leaves gravity by more than four standard
    deviations is none.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map.
        camera: Intrinsics of the image; they are not refined.
        gravity: Which way is down.
        options: How to search.

    Returns:
        The pose, or None when no hypothesis has enough inliers or the matches contradict gravity.

    Raises:
        ValueError: As `estimate_pose` does.

    References:
        [1] Kukelova, Bujnak and Pajdla, Closed-form Solutions to Minimal Absolute Pose Problems with Known
            Vertical Direction, ACCV 2010.
    """
    check_matches(points2D, points3D_in_world)
    if camera.is_spherical():
        raise ValueError(f"camera must have a focal length, got the spherical model {camera.model_name}")
    pixels = undistort(points2D, camera)
    usable = np.isfinite(pixels).all(axis=1)
    if usable.sum() < options.min_inliers:
        return None
    start = _search(
        _Matches(pixels=pixels[usable], in_world=points3D_in_world[usable], pinhole=ideal_pinhole(camera)),
        gravity,
        options,
    )
    found = start and refine(
        points2D, points3D_in_world, start, camera, max_error_px=options.max_error_px, priors=(gravity,)
    )
    if found is None or found.inliers.sum() < options.min_inliers:
        return None
    if np.linalg.norm(gravity.rows(found.cam_from_world, camera).residuals) > _MOST_SIGMAS:
        return None
    return PoseEstimate(
        cam_from_world=found.cam_from_world, inliers=found.inliers, covariance=found.covariance[:6, :6]
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Matches:
    pixels: Points2D  # of the ideal pinhole camera
    in_world: Points3D
    pinhole: dict

    @property
    def focal_px(self) -> float:
        return self.pinhole["params"][0]

    def squared_errors(self, poses: "_Poses") -> Float64[np.ndarray, "k n"]:
        """In pixels; infinite behind the camera."""
        x, y, z = (
            poses.rotations[:, axis] @ self.in_world.T + poses.translations[:, axis, None]
            for axis in range(3)
        )
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            scale = self.focal_px / z
            squares = (scale * x - self.pixels[:, 0]) ** 2 + (scale * y - self.pixels[:, 1]) ** 2
        squares[~(z > 0)] = np.inf
        return squares


@dataclass(frozen=True, kw_only=True, eq=False)
class _Poses:
    rotations: Float64[np.ndarray, "k 3 3"]
    translations: Float64[np.ndarray, "k 3"]

    def __len__(self) -> int:
        return len(self.rotations)

    def row(self, index: int) -> "_Poses":
        return _Poses(
            rotations=self.rotations[index : index + 1], translations=self.translations[index : index + 1]
        )


def _search(matches: _Matches, gravity: Gravity, options: RansacOptions) -> pycolmap.Rigid3d | None:
    """The pose with the least truncated squared errors, of all hypotheses and of optima near the best."""
    rng = np.random.default_rng(options.seed)
    upright = _Upright.of(matches, gravity)
    most = _most_squared_error(matches, gravity, options.max_error_px)
    best, least, tried, enough = None, np.inf, 0, options.max_iterations
    while tried < enough:
        size = min(_BATCH, enough - tried)
        tried += size
        poses = upright.poses(_pairs(rng, len(matches.pixels), size))
        if not len(poses):
            continue
        costs = np.minimum(matches.squared_errors(poses), most).sum(axis=1)
        hypothesis = poses.row(int(np.argmin(costs)))
        for pose in (hypothesis, _optimized(hypothesis, matches, most)):
            squares = matches.squared_errors(pose)[0]
            cost = np.minimum(squares, most).sum()
            if cost < least:
                best, least = pose, cost
                enough = min(enough, hypotheses_to_try(float(np.mean(squares < most)), _SAMPLE))
    if best is None:
        return None
    return pycolmap.Rigid3d(pycolmap.Rotation3d(best.rotations[0]), best.translations[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Upright:
    """PoseLib's solver: it takes camera and world turned so that gravity is along the y axes of both."""

    from_cam: Float64[np.ndarray, "3 3"]
    from_world: Float64[np.ndarray, "3 3"]
    rays: Float64[np.ndarray, "n 3"]
    points: Points3D

    @classmethod
    def of(cls, matches: _Matches, gravity: Gravity) -> "_Upright":
        from_cam, from_world = _to_y_axis(gravity.in_cam), _to_y_axis(gravity.in_world)
        rays = np.column_stack([matches.pixels / matches.focal_px, np.ones(len(matches.pixels))])
        return cls(
            from_cam=from_cam,
            from_world=from_world,
            rays=rays / np.linalg.norm(rays, axis=1, keepdims=True) @ from_cam.T,
            points=matches.in_world @ from_world.T,
        )

    def poses(self, pairs: Int64[np.ndarray, "m 2"]) -> _Poses:
        """Up to two for each pair of matches."""
        pairs_of = zip(self.rays[pairs], self.points[pairs], strict=True)
        solved = [pose for rays, points in pairs_of for pose in poselib.up2p(rays, points)]
        rotations = np.array([pose.R for pose in solved]).reshape(-1, 3, 3)
        translations = np.array([pose.t for pose in solved]).reshape(-1, 3)
        sound = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(translations).all(axis=1)
        return _Poses(
            rotations=self.from_cam.T @ rotations[sound] @ self.from_world,
            translations=translations[sound] @ self.from_cam,
        )


def _pairs(rng: np.random.Generator, count: int, size: int) -> Int64[np.ndarray, "{size} 2"]:
    """Two different matches each."""
    first = rng.integers(count, size=size)
    return np.stack([first, (first + rng.integers(1, count, size=size)) % count], axis=1)


def _optimized(pose: _Poses, matches: _Matches, most: float) -> _Poses:
    """The optimum for the inliers, of any gravity: many matches tell by how much it was wrong."""
    inliers = matches.squared_errors(pose)[0] < most
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


def _most_squared_error(matches: _Matches, gravity: Gravity, max_error_px: float) -> float:
    """Largest of an inlier: of its own, and of a turn of the image about the match it is measured from."""
    spread_px = np.sqrt(np.sum(np.var(matches.pixels, axis=0)))
    return float(max_error_px**2 + (_REACH * np.radians(gravity.uncertainty_deg) * spread_px) ** 2)


def _unit(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    return direction / np.linalg.norm(direction)


def _to_y_axis(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """A rotation that turns a direction onto (0, 1, 0)."""
    y = _unit(direction)
    x = _unit(np.cross(y, np.eye(3)[np.argmin(np.abs(y))]))
    return np.stack([x, y, np.cross(x, y)])
