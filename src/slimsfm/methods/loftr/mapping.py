"""Building a model without a keypoint detector: match cells, reconstruct, refine [1].

References:
    [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation
        without CAD Models, NeurIPS 2022.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.arrays import IndexPairs, Mask, Points2D
from slimsfm.features import Features, image_colors
from slimsfm.mapping.choice import PickedModel, pick_model
from slimsfm.mapping.extraction import color_points
from slimsfm.mapping.matching import verify_matches
from slimsfm.mapping.pairs import Matches, Pairs
from slimsfm.mapping.reconstruction import reconstruct
from slimsfm.mapping.scratch import verified_matches, write_database, write_geometries
from slimsfm.mapping.sfm import adjust, triangulate
from slimsfm.mapping.shrinking import ShrunkImages
from slimsfm.mapping.workspace import DATABASE, SFM, Workspace
from slimsfm.methods.loftr.cells import (
    CellKeypoints,
    EncodedImage,
    ImageMatcher,
    Photo,
    PhotoMask,
    in_tiles,
    match_without_keypoints,
)
from slimsfm.methods.loftr.rays import (
    Depths,
    RayObservations,
    Tracks,
    choose_references,
    rays_of,
    read_tracks,
    refine_depths,
)
from slimsfm.progress import ProgressBar, silent

_CACHED = 24  # fully encoded images kept in memory: 45 MB each at 640 x 480

Encode = Callable[[str], EncodedImage]
"""Encodes the image with a given name."""

_Rows = Int64[np.ndarray, " _"]


@dataclass(frozen=True, kw_only=True)
class RefinementOptions:
    """Which observations the refinement drops."""

    max_error_cells: float = 0.5
    """Largest reprojection error of an observation in cells; half a cell is 4 pixels of the matcher's
    input."""

    def __post_init__(self) -> None:
        if not self.max_error_cells > 0:
            raise ValueError(f"max_error_cells must be positive, got {self.max_error_cells}")


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedModel:
    """A model with refined keypoints, only those that observe a point."""

    model: pycolmap.Reconstruction
    """Ids, names, cameras and poses are unchanged."""

    features: Mapping[str, Features]
    """Keypoints by image name, with the matcher's descriptors in half precision."""

    rows: Mapping[str, _Rows]
    """Row of each keypoint before the refinement, ascending, by image name."""

    def matches(self, before: Matches) -> Matches:
        """Renumber matches from before the refinement, without those of dropped keypoints."""
        kept = {(a, b): self._kept(a, b, before[a, b]) for a, b in sorted(before)}
        return {pair: pairs for pair, pairs in kept.items() if len(pairs)}

    def _kept(self, a: str, b: str, pairs: IndexPairs) -> Int64[np.ndarray, "k 2"]:
        both = np.isin(pairs[:, 0], self.rows[a]) & np.isin(pairs[:, 1], self.rows[b])
        columns = zip((a, b), pairs[both].T, strict=True)
        return np.stack([np.searchsorted(self.rows[name], rows) for name, rows in columns], axis=1)


def refine_model(
    model: pycolmap.Reconstruction,
    cells: CellKeypoints,
    photos: Mapping[str, Photo],
    matcher: ImageMatcher,
    options: RefinementOptions = RefinementOptions(),
    progress: ProgressBar = silent,
) -> RefinedModel:
    """Align the observations of each point with its reference, and move the point accordingly.

    Poses and cameras do not change.

    Args:
        model: A model whose keypoints are those of `cells`, row by row.
        cells: The cells from which it was reconstructed.
        photos: Photos by name, read on access.
        matcher: The matcher of these cells.
        options: Which observations to drop.
        progress: Progress callback.
    """
    tracks = read_tracks(model)
    is_reference = choose_references(tracks)
    encode = lru_cache(_CACHED)(lambda name: matcher.encode(photos[name]))
    tracks = replace(tracks, points2D=_align(tracks, is_reference, matcher, encode, progress))
    limits = options.max_error_cells * np.array([cells.cell_px[name] for name in tracks.names])
    rays = rays_of(model, tracks, is_reference)
    depths, agrees = _fit(rays.observations, rays.depths, limits[tracks.images[rays.others]])
    tracks = replace(tracks, points3D_in_world=rays.points3D_in_world(depths))
    kept = _kept(tracks, is_reference, rays.others[agrees])
    parts = [kept[tracks.images[kept] == image] for image in range(len(tracks.names))]
    features = {
        name: _described(cells.features[name], tracks, part, matcher, encode(name))
        for name, part in progress(list(zip(tracks.names, parts, strict=True)), "describe keypoints")
    }
    return RefinedModel(
        model=_with_tracks(model, tracks, parts),
        features=features,
        rows={name: tracks.keypoints[part] for name, part in zip(tracks.names, parts, strict=True)},
    )


def _described(
    before: Features, tracks: Tracks, part: _Rows, matcher: ImageMatcher, encoded: EncodedImage
) -> Features:
    """Features of an image with refined keypoints."""
    pixels = tracks.points2D[part]
    return replace(
        before[tracks.keypoints[part]],
        keypoints=pixels.astype(np.float32),
        descriptors=matcher.describe(encoded, pixels),
    )


def _align(
    tracks: Tracks, is_reference: Mask, matcher: ImageMatcher, encode: Encode, progress: ProgressBar
) -> Points2D:
    """Pixels of all observations, aligned with the reference of their point."""
    references, others = np.flatnonzero(is_reference), np.flatnonzero(~is_reference)
    references = references[tracks.points[others]]
    points2D = tracks.points2D.copy()
    by_pair: dict[tuple[str, str], list[int]] = defaultdict(list)
    for row, images in enumerate(zip(tracks.images[references], tracks.images[others], strict=True)):
        one, other = (tracks.names[image] for image in images)
        by_pair[one, other].append(row)
    for pair in progress(in_tiles(list(by_pair), _CACHED // 2), "align keypoints"):
        one, other = references[by_pair[pair]], others[by_pair[pair]]
        places = tracks.points2D[one], tracks.points2D[other]
        points2D[other] = matcher.align(encode(pair[0]), encode(pair[1]), *places)
    return points2D


def _fit(
    observations: RayObservations, depths: Depths, limits_px: Float64[np.ndarray, " n"]
) -> tuple[Depths, Mask]:
    """Fit depths to the observations, without outliers; also returns which observations are inliers."""
    agrees = np.ones(len(observations.points), dtype=bool)
    for _ in range(2):
        depths = refine_depths(observations[np.flatnonzero(agrees)], depths)
        agrees &= observations.errors(depths) <= limits_px
    return depths, agrees


def _kept(tracks: Tracks, is_reference: Mask, agreeing: Int64[np.ndarray, " _"]) -> Int64[np.ndarray, " _"]:
    """Inliers and the references of their points, sorted by image, then keypoint."""
    kept = is_reference & np.isin(tracks.points, tracks.points[agreeing])
    kept[agreeing] = True
    rows = np.flatnonzero(kept)
    return rows[np.lexsort([tracks.keypoints[rows], tracks.images[rows]])]


def _with_tracks(
    model: pycolmap.Reconstruction, tracks: Tracks, parts: list[_Rows]
) -> pycolmap.Reconstruction:
    """Copy a model with only these observations and their points."""
    refined = pycolmap.Reconstruction(model)
    refined.delete_all_points2D_and_points3D()
    elements: dict[int, list[pycolmap.TrackElement]] = defaultdict(list)
    ids = {image.name: image_id for image_id, image in model.images.items()}
    for name, mine in zip(tracks.names, parts, strict=True):
        pixels = [pycolmap.Point2D(xy) for xy in tracks.points2D[mine]]
        refined.image(ids[name]).points2D = pycolmap.Point2DList(pixels)
        for row, point in enumerate(tracks.points[mine].tolist()):
            elements[point].append(pycolmap.TrackElement(ids[name], row))
    for point, track in sorted(elements.items()):
        point3D_id = int(tracks.point3D_ids[point])
        moved = pycolmap.Point3D(xyz=tracks.points3D_in_world[point], color=model.point3D(point3D_id).color)
        moved.track = pycolmap.Track(track)
        refined.add_point3D_with_id(point3D_id, moved)
    refined.update_point_3d_errors()
    return refined


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

    picked: PickedModel | None = None
    """The model as it was picked; None with known poses."""


def build_without_keypoints(
    photos: Mapping[str, Photo],
    pairs: Pairs,
    matcher: ImageMatcher,
    cameras: Mapping[str, pycolmap.Camera],
    workspace: Workspace,
    *,
    cam_from_world: Mapping[str, pycolmap.Rigid3d] | None = None,
    masks: Mapping[str, PhotoMask] | None = None,
    number: int = 1,
    split: bool = True,
    seed: int = 0,
    progress: ProgressBar = silent,
) -> KeypointFreeModel:
    """Build a model from photos without a keypoint detector.

    Args:
        photos: Photos by name.
        pairs: Pairs of names to match.
        matcher: Matches the photos.
        cameras: Intrinsics by image name; images with equal `camera_id` share a camera.
        workspace: Intermediate files.
        cam_from_world: Known poses by image name; then poses and cameras are not refined.
        masks: Masks by name, of the same sizes as the photos; cells where a mask is 0 are not matched.
        number: Which model to keep if there are several, from 1, the largest.
        split: Give photos of one camera several cameras if their focal lengths differ.
        seed: Seed of all random choices.
        progress: Progress callback.

    Raises:
        InputError: A photo cannot be used, or there are fewer models.
        ReconstructionError: No model can be reconstructed from the photos.
    """
    cells = match_without_keypoints(photos, pairs, matcher, workspace, masks, progress)
    rough, picked, matches = _reconstruct(
        cells, cameras, cam_from_world, workspace.folder, number, split, seed, progress
    )
    refined = refine_model(rough, cells, photos, matcher, progress=progress)
    if cam_from_world is None:
        _adjust(refined.model, max(1.0, float(np.median(list(cells.cell_px.values()))) / _CELL_PX))
    seen = refined.features.items()
    color_points(refined.model, {name: image_colors(photos[name], one.keypoints) for name, one in seen})
    return KeypointFreeModel(
        model=refined.model, features=refined.features, matches=refined.matches(matches), picked=picked
    )


def _reconstruct(
    cells: CellKeypoints,
    cameras: Mapping[str, pycolmap.Camera],
    cam_from_world: Mapping[str, pycolmap.Rigid3d] | None,
    folder: Path,
    number: int,
    split: bool,
    seed: int,
    progress: ProgressBar,
) -> tuple[pycolmap.Reconstruction, PickedModel | None, Matches]:
    """Reconstruct a model from cells; also returns how it was picked, and the verified matches.

    COLMAP's limits are in pixels, so images are scaled until a cell has 8 of them.
    """
    names, database = sorted(cells.features), folder / DATABASE
    factors = {name: cells.cell_px[name] / _CELL_PX for name in names}
    shrunk = ShrunkImages(whole=cells.features, whole_cameras=cameras, factors=factors)
    small = shrunk.cameras
    for camera in small.values():
        camera.has_prior_focal_length |= cam_from_world is not None
    write_database(database, shrunk.features, small)
    geometries = verify_matches(shrunk.features, small, cells.matches, seed=seed, progress=progress)
    write_geometries(database, names, geometries)
    picked = None
    if cam_from_world is not None:
        model = triangulate(database, names, folder / SFM, cam_from_world, seed=seed, progress=progress)
    else:
        models = reconstruct(database, names, folder / SFM, seed=seed, split=split, progress=progress)
        picked = pick_model(models, number)
        model = picked.model
    matches = verified_matches(database, {i: model.image(i).name for i in model.reg_image_ids()})
    shrunk.enlarge(model, known_cameras=cam_from_world is not None)
    return model, picked, matches


def _adjust(model: pycolmap.Reconstruction, scale_px: float) -> None:
    """Adjust poses and focal lengths, which were estimated from the less exact cells.

    Args:
        model: The model.
        scale_px: Errors beyond it count less.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale_px
    adjust(model, options)
    model.update_point_3d_errors()
