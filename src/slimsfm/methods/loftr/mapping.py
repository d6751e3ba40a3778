"""Building a model without a keypoint detector: match cells, reconstruct, refine [1].

References:
    [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation
        without CAD Models, NeurIPS 2022.
"""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from threadpoolctl import threadpool_limits

from slimsfm.features import Features, image_colors
from slimsfm.mapping.extraction import color_points, mask_of
from slimsfm.mapping.pairs import Pairs, verify_pairs
from slimsfm.mapping.sfm import reconstruct, triangulate, verified_matches, write_database
from slimsfm.methods.loftr.cells import CellKeypoints, Matches, match_without_keypoints
from slimsfm.methods.loftr.image_matching import ImageMatcher, Photo
from slimsfm.methods.loftr.refinement import refine_model
from slimsfm.progress import ProgressBar, silent

_CELL_PX = 8.0  # side of a cell for which COLMAP's error limits of 4 pixels are right


@dataclass(frozen=True, kw_only=True, eq=False)
class KeypointFreeModel:
    """The SfM part of a map without a detector."""

    model: pycolmap.Reconstruction
    """Keypoint i of an image is row i of its features."""

    features: Mapping[str, Features]
    """Keypoints by image name; each observes a point."""

    matches: Matches
    """Verified matches between these keypoints."""


def build_without_keypoints(
    photos: Mapping[str, Photo],
    pairs: Pairs,
    matcher: ImageMatcher,
    cameras: Mapping[str, pycolmap.Camera],
    workspace: Path,
    *,
    cam_from_world: Mapping[str, pycolmap.Rigid3d] | None = None,
    masks: Path | None = None,
    seed: int = 0,
    progress: ProgressBar = silent,
) -> KeypointFreeModel:
    """Build a model from photos without a keypoint detector.

    Args:
        photos: Photos by name.
        pairs: Pairs of names to match.
        matcher: Matches the photos.
        cameras: Intrinsics by image name; images with equal `camera_id` share a camera.
        workspace: Folder for intermediate files.
        cam_from_world: Known poses by image name; then poses and cameras are not refined.
        masks: Folder of masks; cells where a mask is black are not matched.
        seed: Seed of all random choices.
        progress: Progress callback.

    Raises:
        InputError: A photo or a mask cannot be used.
        ReconstructionError: No model can be reconstructed from the photos.
    """
    read = {name: mask_of(masks, name, photos[name].shape[:2]) for name in photos} if masks else {}
    masked = {name: mask for name, mask in read.items() if mask is not None}
    cells = match_without_keypoints(photos, pairs, matcher, masked, progress)
    rough, matches = _reconstruct(cells, cameras, cam_from_world, workspace, seed, progress)
    refined = refine_model(rough, cells, photos, matcher, progress=progress)
    if cam_from_world is None:
        _adjust(refined.model)
    seen = refined.features.items()
    color_points(refined.model, {name: image_colors(photos[name], one.keypoints) for name, one in seen})
    return KeypointFreeModel(model=refined.model, features=refined.features, matches=refined.matches(matches))


def _reconstruct(
    cells: CellKeypoints,
    cameras: Mapping[str, pycolmap.Camera],
    cam_from_world: Mapping[str, pycolmap.Rigid3d] | None,
    workspace: Path,
    seed: int,
    progress: ProgressBar,
) -> tuple[pycolmap.Reconstruction, Matches]:
    """Reconstruct a model from cells; also returns their verified matches.

    COLMAP's limits are in pixels, so images are scaled until a cell has 8 of them.
    """
    names, database = sorted(cells.features), workspace / "database.db"
    factors = {name: cells.cell_px[name] / _CELL_PX for name in names}
    small = {name: _scaled(cameras[name], 1 / factors[name]) for name in names}
    for camera in small.values():
        camera.has_prior_focal_length |= cam_from_world is not None
    coarse = {name: _shrunk(cells.features[name], factors[name]) for name in names}
    write_database(database, coarse, small)
    verify_pairs(database, names, cells.matches, seed=seed, progress=progress)
    if cam_from_world is not None:
        model = triangulate(database, names, workspace / "sfm", cam_from_world, seed=seed, progress=progress)
    else:
        model = reconstruct(database, names, workspace / "sfm", seed=seed, progress=progress)
    matches = verified_matches(database, {i: model.image(i).name for i in model.reg_image_ids()})
    _enlarge(model, cells, factors, cameras, exact=cam_from_world is not None)
    return model, matches


def _scaled(camera: pycolmap.Camera, factor: float) -> pycolmap.Camera:
    """The camera of the image after scaling it by a factor."""
    scaled, params = copy(camera), camera.params.copy()
    params[[*camera.focal_length_idxs(), *camera.principal_point_idxs()]] *= factor
    scaled.params = params.tolist()
    scaled.width, scaled.height = round(camera.width * factor), round(camera.height * factor)
    return scaled


def _shrunk(features: Features, factor: float) -> Features:
    return replace(features, keypoints=(features.keypoints / factor).astype(np.float32))


def _enlarge(
    model: pycolmap.Reconstruction,
    cells: CellKeypoints,
    factors: Mapping[str, float],
    cameras: Mapping[str, pycolmap.Camera],
    *,
    exact: bool,
) -> None:
    """Scale a model from small images to the photos; with `exact`, it gets the given cameras unchanged."""
    names = {cameras[name].camera_id: name for name in factors}
    for camera_id, camera in model.cameras.items():
        name = names[camera_id]
        whole = cameras[name] if exact else _scaled(camera, factors[name])
        camera.params = whole.params.tolist()
        camera.width, camera.height = cameras[name].width, cameras[name].height
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        for point, xy in zip(image.points2D, cells.features[image.name].keypoints, strict=True):
            point.xy = xy.astype(np.float64)


def _adjust(model: pycolmap.Reconstruction) -> None:
    """Adjust poses and focal lengths, which were estimated from the less exact cells."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = 1
    with threadpool_limits(1):  # results must not depend on the number of threads
        pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
