"""The pose of a camera whose focal length is unknown, or known roughly."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points2D, Points3D
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose
from slimsfm.ransac import hypotheses_to_try
from slimsfm.refinement import PriorRows, Refinement, refine, with_focal_length

_USUAL = 1.2  # focal length over the longer side, as COLMAP guesses
_TRIED = (0.23, 5.3)  # over the longer side: fields of view of 130 to 11 degrees
_POSSIBLE = (0.1, 10.0)  # over the longer side: COLMAP too takes none beyond for a photograph's
_STRIDE = 1.43  # ratio of neighbours among those tried; an error of a fifth leaves a third of the inliers
_LEAST_INLIERS = 4  # of a hypothesis
_SAMPLE = 3  # matches that P3P needs


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseAndFocal:
    """Where a camera stood, and its focal length."""

    pose: PoseEstimate
    """The pose, and the matches that agree with it through `camera`."""

    camera: pycolmap.Camera
    """The given camera with the focal length that was found."""

    relative_sigma: float
    """Standard deviation of the focal length over the focal length. Where the matches do not tell it, as on a
    wall seen from the front, it is about as large as it was beforehand."""


def estimate_pose_and_focal(
    points2D: Points2D,
    points3D_in_world: Points3D,
    camera: pycolmap.Camera,
    options: RansacOptions = RansacOptions(),
    *,
    relative_uncertainty: float | None = None,
) -> PoseAndFocal | None:
    """Estimate pose and focal length from 2D-3D matches.

    P3P inside LO-RANSAC at several focal lengths [1], then a refinement of pose and focal length together,
    from the hypothesis with the most inliers. At a focal length that is wrong by a fifth, a pose shows with
    fewer inliers; P3P takes any lens distortion, and needs one match less than a solver for both. A prior
    keeps the focal length near the expected one where the matches do not tell it.

    Args:
        points2D: Pixels; row i matches row i of `points3D_in_world`.
        points3D_in_world: Points in the frame and unit of the map.
        camera: Its principal point stays, and its distortion in normalized coordinates. Two focal lengths
            keep their ratio.
        options: How to search; the focal lengths tried share the hypotheses.
        relative_uncertainty: How wrong the camera's focal length may be: 0.3 is 30 %, and no more than that.
            None is any: the camera's is ignored, one of 1.2 times the longer side of the image expected, to a
            factor of 2, and any from a tenth to ten times the longer side allowed.

    Returns:
        Pose and camera, or None when no hypothesis has enough inliers.

    Raises:
        ValueError: `estimate_pose` would raise it, the camera's focal length or size is not positive, or the
            uncertainty is not between 0 and 1.

    References:
        [1] Sattler, Sweeney and Pollefeys, On Sampling Focal Length Values to Solve the Absolute Pose
            Problem, ECCV 2014.
    """
    prior = _prior(camera, relative_uncertainty)
    hypothesis = _best_hypothesis(points2D, points3D_in_world, camera, options, prior)
    found = hypothesis and _refined(points2D, points3D_in_world, hypothesis, options, prior)
    if found is None or found.inliers.sum() < options.min_inliers:
        return None
    pose = PoseEstimate(
        cam_from_world=found.cam_from_world, inliers=found.inliers, covariance=found.covariance[:6, :6]
    )
    return PoseAndFocal(pose=pose, camera=found.camera, relative_sigma=float(found.covariance[6, 6] ** 0.5))


@dataclass(frozen=True, kw_only=True, eq=False)
class _FocalPrior:
    expected_px: float
    sigma: float  # of the logarithm
    limits_px: tuple[float, float]
    tried_px: Float64[np.ndarray, " k"]

    def rows(self, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> PriorRows:  # noqa: ARG002
        deviation = np.log(camera.mean_focal_length() / self.expected_px) / self.sigma
        return PriorRows(residuals=np.array([deviation]), jacobian=np.eye(7)[6:] / self.sigma)


def _prior(camera: pycolmap.Camera, relative_uncertainty: float | None) -> _FocalPrior:
    if camera.is_spherical():
        raise ValueError(f"camera must have a focal length, got the spherical model {camera.model_name}")
    if not np.all(camera.params[camera.focal_length_idxs()] > 0):
        raise ValueError(f"camera must have a positive focal length, got {camera.params_to_string()}")
    if relative_uncertainty is None:
        return _wide_prior(camera)
    if not 0 < relative_uncertainty < 1:
        raise ValueError(f"relative_uncertainty must be between 0 and 1, got {relative_uncertainty}")
    expected_px = camera.mean_focal_length()
    # Covers an error that is relative to the expected focal length as well as one relative to the true one.
    limits_px = (expected_px * (1 - relative_uncertainty), expected_px / (1 - relative_uncertainty))
    return _FocalPrior(
        expected_px=expected_px,
        sigma=-np.log1p(-relative_uncertainty) / 2,
        limits_px=limits_px,
        tried_px=_grid(*limits_px, expected_px),
    )


def _wide_prior(camera: pycolmap.Camera) -> _FocalPrior:
    if not (camera.width > 0 and camera.height > 0):
        raise ValueError(f"camera must have the size of the image, got {camera.width}x{camera.height}")
    longer_px = max(camera.width, camera.height)
    return _FocalPrior(
        expected_px=_USUAL * longer_px,
        sigma=np.log(2),
        limits_px=(_POSSIBLE[0] * longer_px, _POSSIBLE[1] * longer_px),
        tried_px=_grid(_TRIED[0] * longer_px, _TRIED[1] * longer_px, _USUAL * longer_px),
    )


def _grid(low: float, high: float, expected: float) -> Float64[np.ndarray, " k"]:
    """Geometric means of the parts of a range, each of which spans one stride or less; likely ones first."""
    count = int(np.ceil(np.log(high / low) / np.log(_STRIDE)))
    values = low * (high / low) ** ((np.arange(count) + 0.5) / count)
    return values[np.argsort(np.abs(np.log(values / expected)), kind="stable")]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Hypothesis:
    pose: PoseEstimate
    camera: pycolmap.Camera


def _best_hypothesis(
    points2D: Points2D,
    points3D_in_world: Points3D,
    camera: pycolmap.Camera,
    options: RansacOptions,
    prior: _FocalPrior,
) -> _Hypothesis | None:
    """The pose with the most inliers, some of which a wrong focal length may hide; the likely of equals."""
    best, most = None, 0
    share = -(-options.max_iterations // len(prior.tried_px))
    for focal_px in prior.tried_px:
        tried = with_focal_length(camera, float(focal_px))
        enough = hypotheses_to_try(most / max(len(points2D), 1), _SAMPLE)
        eased = replace(options, max_iterations=min(share, enough), min_inliers=_LEAST_INLIERS)
        pose = estimate_pose(points2D, points3D_in_world, tried, eased)
        if pose and pose.num_inliers > most:
            best, most = _Hypothesis(pose=pose, camera=tried), pose.num_inliers
        if most > len(points2D) / 2:  # a pose with more would share inliers with this one
            break
    return best


def _refined(
    points2D: Points2D,
    points3D_in_world: Points3D,
    start: _Hypothesis,
    options: RansacOptions,
    prior: _FocalPrior,
) -> Refinement | None:
    """The most probable pose and focal length; the pose at the limit if the focal length would pass it."""

    def refined(camera: pycolmap.Camera, free_focal: bool) -> Refinement | None:
        return refine(
            points2D,
            points3D_in_world,
            start.pose.cam_from_world,
            camera,
            max_error_px=options.max_error_px,
            priors=(prior,),
            free_focal=free_focal,
        )

    found = refined(start.camera, True)
    if found is None:
        return None
    focal_px = found.camera.mean_focal_length()
    limited_px = float(np.clip(focal_px, *prior.limits_px))
    return found if limited_px == focal_px else refined(with_focal_length(start.camera, limited_px), False)
