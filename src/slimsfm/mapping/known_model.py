"""Build a model from known poses: check that matches agree with them, triangulate, adjust them if asked."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from threadpoolctl import threadpool_limits

from slimsfm.geometry import rotation_error_deg
from slimsfm.mapping.conventions import check_convention, inexactness_px, read_rays
from slimsfm.mapping.sfm import triangulate
from slimsfm.mapping.work import KnownPoses
from slimsfm.progress import ProgressBar, silent, single_step

_ROUNDS = 2  # of adjusting the poses and triangulating again
_SPREAD = 0.01  # standard deviation of a given center, over the distance of the centers from their mean
_LOSS_PX = 1.0  # beyond which errors count less
_EXACT_PX, _MOST_TOLERANT = 0.7, 2.0  # epipolar error with which COLMAP's limits are right; most times these


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownModel:
    """A model from known poses."""

    model: pycolmap.Reconstruction
    """The model."""

    notes: tuple[str, ...] = ()
    """By how much the poses were adjusted, if they were."""


def triangulate_known(
    database: Path,
    names: list[str],
    workspace: Path,
    known: KnownPoses,
    *,
    seed: int,
    progress: ProgressBar = silent,
) -> KnownModel:
    """Triangulate the matches of a database from known poses.

    The poses stay as they are or, with `KnownPoses.refine`, are adjusted together with the points. Then the
    given camera centers are observations with a standard deviation of 1 % of their spread, and the result is
    turned as one to the given rotations, which keeps frame and unit, also of parts that share no point.

    Poses of a file are as exact as the device that measured them. The less exact, by the matches, the larger
    are the errors that points may have.

    Args:
        database: COLMAP's database with verified matches.
        names: Names of the images, which the database numbers from 1.
        workspace: Folder for COLMAP's files.
        known: Cameras and poses.
        seed: Seed of every random choice.
        progress: Progress callback.

    Raises:
        InputError: The matches say that the poses were read in the wrong convention.
        ReconstructionError: No point could be triangulated.
    """
    poses = {name: known.cam_from_world[name] for name in names}
    if known.convention is not None:
        check_convention(database, names, poses, known.convention, known.source)
    is_measured = known.convention is not None or known.refine
    pairs = read_rays(database, names) if is_measured else []

    def triangulated(poses: Mapping[str, pycolmap.Rigid3d]) -> pycolmap.Reconstruction:
        tolerance = min(max(1.0, inexactness_px(pairs, poses) / _EXACT_PX), _MOST_TOLERANT)
        common = {"seed": seed, "progress": progress, "tolerance": tolerance}
        return triangulate(database, names, workspace, poses, **common)

    model, refined = triangulated(poses), poses
    if not known.refine:
        return KnownModel(model=model)
    for _ in range(_ROUNDS):
        with single_step(progress, "adjust poses"):
            refined = _adjusted(model, poses)
        model = triangulated(refined)
    return KnownModel(model=model, notes=(_moved(poses, refined),))


def _adjusted(
    model: pycolmap.Reconstruction, given: Mapping[str, pycolmap.Rigid3d]
) -> dict[str, pycolmap.Rigid3d]:
    """Poses that agree with the matches; those of images without a point stay as they were given."""
    model = pycolmap.Reconstruction(model)
    centers = np.array([pose.inverse().translation for pose in given.values()])
    spread = float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean()))
    seeing = [i for i in sorted(model.reg_image_ids()) if model.image(i).num_points3D]
    if spread > 0 and len(seeing) > 1:
        _adjust(model, given, seeing, _SPREAD * spread)
    adjusted = {model.image(i).name: model.image(i).cam_from_world() for i in seeing}
    adjusted = _turned_back(adjusted, given)
    return {name: adjusted.get(name, pose) for name, pose in given.items()}


def _turned_back(
    adjusted: Mapping[str, pycolmap.Rigid3d], given: Mapping[str, pycolmap.Rigid3d]
) -> dict[str, pycolmap.Rigid3d]:
    """Poses turned and moved as one to the given ones, because centers on a line let the world turn about it.

    The mean of the rotations (chordal) and of the centers are then those of the given poses.
    """
    if not adjusted:
        return {}
    turns = [given[name].rotation.matrix().T @ pose.rotation.matrix() for name, pose in adjusted.items()]
    left, _, right = np.linalg.svd(np.sum(turns, axis=0))
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    centers = np.mean([pose.inverse().translation for pose in adjusted.values()], axis=0)
    goal = np.mean([given[name].inverse().translation for name in adjusted], axis=0)
    given_from_adjusted = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), goal - turn @ centers)
    return {name: pose * given_from_adjusted.inverse() for name, pose in adjusted.items()}


def _adjust(
    model: pycolmap.Reconstruction,
    given: Mapping[str, pycolmap.Rigid3d],
    seeing: list[int],
    deviation: float,
) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS_PX
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    priors = []
    for image_id in seeing:
        config.add_image(image_id)
        image = model.image(image_id)
        priors.append(
            pycolmap.PosePrior(
                corr_data_id=image.data_id,
                position=given[image.name].inverse().translation,
                position_covariance=np.eye(3) * deviation**2,
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    prior_options.alignment_ransac.random_seed = 0
    with threadpool_limits(1):  # results must not depend on the number of threads
        pycolmap.create_pose_prior_bundle_adjuster(options, prior_options, config, priors, model).solve()


def _moved(given: Mapping[str, pycolmap.Rigid3d], refined: Mapping[str, pycolmap.Rigid3d]) -> str:
    """How far poses are from those that were given, as a sentence."""
    moved = [
        float(np.linalg.norm(refined[name].inverse().translation - pose.inverse().translation))
        for name, pose in given.items()
    ]
    turned = [rotation_error_deg(refined[name], pose) for name, pose in given.items()]
    return (
        f"poses adjusted to the matches: cameras moved by {np.median(moved):.3g} (median) and at most "
        f"{max(moved):.3g} map units, turned by {np.median(turned):.2g}° and at most {max(turned):.2g}°"
    )
