"""How good poses are: the paper's metrics, per query and over many."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64
from scipy.spatial import KDTree

from slimsfm.arrays import Points3D
from slimsfm.datasets.base import ObjectModel
from slimsfm.geometry import Box, corner_error, rotation_error_deg, translation_error

DEG_CM = (1, 3, 5)
"""n of n degrees - n cm."""

SURE = 0.9
"""Confidence over which a pose is taken for right."""


@dataclass(frozen=True, kw_only=True)
class PoseError:
    """How far a pose is from the true one; everything is infinite where there is no pose."""

    relative: float
    """Mean distance of the box's corners under the two poses, over the diagonal. Where the data set has a
    model of the object: of its vertices, over its diameter."""

    rotation_deg: float
    """Angle between the two, in [0, 180]."""

    translation: float
    """Distance between where the two put the origin before the camera, in map units."""


NO_POSE = PoseError(relative=np.inf, rotation_deg=np.inf, translation=np.inf)
"""A query that could not be localized counts as infinitely wrong."""


def pose_error(
    estimated_cam_from_world: pycolmap.Rigid3d | None,
    true_cam_from_world: pycolmap.Rigid3d,
    box: Box,
    model: ObjectModel | None = None,
) -> PoseError:
    """Compare an estimated pose with the true one.

    Args:
        estimated_cam_from_world: The estimate, or None where there is none.
        true_cam_from_world: The truth.
        box: The object's box: its corners are what the paper measures.
        model: The object's model, where the data set has one: its vertices are measured instead [1], for a
            symmetric object each to the nearest one of the truth.

    References:
        [1] Hinterstoisser et al., Model Based Training, Detection and Pose Estimation of Texture-less 3D
            Objects in Heavily Cluttered Scenes, ACCV 2012: ADD, and for symmetric objects ADD-S.
    """
    if estimated_cam_from_world is None:
        return NO_POSE
    if model is None:
        relative = corner_error(estimated_cam_from_world, true_cam_from_world, box)
    else:
        relative = model_error(estimated_cam_from_world, true_cam_from_world, model)
    return PoseError(
        relative=relative,
        rotation_deg=rotation_error_deg(estimated_cam_from_world, true_cam_from_world),
        translation=translation_error(estimated_cam_from_world, true_cam_from_world),
    )


def model_error(
    estimated_cam_from_world: pycolmap.Rigid3d, true_cam_from_world: pycolmap.Rigid3d, model: ObjectModel
) -> float:
    """ADD, or ADD-S where the object is symmetric: mean distance of vertices over the diameter."""
    estimated, true = (pose * model.vertices for pose in (estimated_cam_from_world, true_cam_from_world))
    return float(_distances(estimated, true, nearest=model.symmetric).mean() / model.diameter)


def _distances(estimated: Points3D, true: Points3D, *, nearest: bool) -> Float64[np.ndarray, " n"]:
    """From each vertex where it truly is to where it is thought to be, or to the nearest one there."""
    if nearest:
        return np.asarray(KDTree(estimated).query(true)[0], np.float64)
    return np.linalg.norm(estimated - true, axis=1)


def add_percent(errors: Float64[np.ndarray, " n"], fraction: float) -> float:
    """Modified ADD: percentage of queries whose relative error is below a fraction of the diagonal.

    The paper replaces the mean distance of a model's points by that of the box's corners and calls the box's
    longest diagonal the diameter d; with fraction 0.1 this is its ADD-0.1d. No pose is a failure.
    """
    return 100 * float(np.mean(errors < fraction))


def deg_cm_percent(
    rotations_deg: Float64[np.ndarray, " n"], translations_in_metres: Float64[np.ndarray, " n"], n: int
) -> float:
    """Percentage of queries within n degrees and n cm, both at once; no pose is a failure."""
    return 100 * float(np.mean(within_deg_cm(rotations_deg, translations_in_metres, n)))


def within_deg_cm(
    rotations_deg: Float64[np.ndarray, " n"], translations_in_metres: Float64[np.ndarray, " n"], n: int
) -> np.ndarray:
    """Which queries are within n degrees and n cm."""
    return (rotations_deg <= n) & (100 * translations_in_metres <= n)


def wrong_when_sure(
    errors: Float64[np.ndarray, " n"], confidence: Float64[np.ndarray, " n"], fraction: float
) -> float | None:
    """Share of wrong poses among those whose confidence is over `SURE`; None where there is no such pose.

    Confidence is the probability that the corner error is below a tenth of the diagonal, so a tenth of the
    poses, at most, should be wrong.
    """
    sure = confidence > SURE  # NaN, no confidence, is not
    return float(np.mean(errors[sure] >= fraction)) if sure.any() else None


def errors_of_poses(
    poses: Sequence[pycolmap.Rigid3d | None],
    truth: Sequence[pycolmap.Rigid3d],
    box: Box,
    model: ObjectModel | None = None,
) -> list[PoseError]:
    """`pose_error` of each."""
    return [pose_error(pose, true, box, model) for pose, true in zip(poses, truth, strict=True)]
