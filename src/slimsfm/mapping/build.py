"""Photos to map."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import pycolmap

from slimsfm.arrays import Image
from slimsfm.errors import InputError
from slimsfm.features import Extractor, Features, load_extractor, load_matcher
from slimsfm.features.store import FeatureFile
from slimsfm.geometry import Box
from slimsfm.mapping.box import estimate_box, read_box
from slimsfm.mapping.cameras import CameraSharing, guess_cameras
from slimsfm.mapping.extraction import color_points, extract_features
from slimsfm.mapping.global_descriptors import with_global_descriptors
from slimsfm.mapping.map import Map, MapInfo
from slimsfm.mapping.pair_matching import match_pairs_with, verify_pairs
from slimsfm.mapping.pairs import Matches, PairChoice, choose_pairs
from slimsfm.mapping.sfm import (
    match_pairs,
    put_keypoints,
    reconstruct,
    triangulate,
    verified_matches,
    write_database,
)
from slimsfm.photos import list_images
from slimsfm.progress import ProgressBar, silent


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """How a map is built from photos."""

    camera: CameraSharing = "auto"
    """Which images share a camera: all, none, or (auto) those of equal size and EXIF focal length."""

    pairs: PairChoice = "auto"
    """Images to match: each with every other one, with its neighbours in order of name, or with those that
    look alike. Auto: exhaustive up to 200 images, above that sequential and similar; without a detector
    exhaustive up to 30, above that by pose where poses are known, else sequential."""

    masks: Path | None = None
    """Folder of masks, NAME.png for image NAME (COLMAP's convention): no features where they are black."""

    extractor: str = "sift"
    """Local features, see `slimsfm methods`; loftr finds none and matches images as wholes."""

    matcher: str = "nearest"
    """What matches features: nearest, lightglue or superglue."""

    max_image_size: int | None = None
    """Shrink larger images for extraction so that their longer side has this many pixels; else as the
    extractor does by itself: SIFT to 1600, learned ones to 1024, loftr to 640."""

    max_features: int | None = None
    """Most features of one image; else what the extractor does by itself: SIFT 4096, learned ones 2048."""

    box: Path | None = None
    """The object's box: JSON or OnePose's box3d_corners.txt. Without it the box is estimated."""

    seed: int = 0
    """Seed of every random choice."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


@dataclass(frozen=True, kw_only=True)
class KnownPoses:
    """Cameras and poses known beforehand, by image name, with the box in their world; none is refined."""

    cameras: Mapping[str, pycolmap.Camera]
    """Intrinsics; images with equal `camera_id` share a camera."""

    cam_from_world: Mapping[str, pycolmap.Rigid3d]
    """Poses."""

    box: Box
    """The object's box."""

    unit: str
    """Unit of the world."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Build:
    """A map and what did not get into it."""

    map: Map
    """The map."""

    left_out: tuple[str, ...]
    """Names of images without a place in the model."""


def build_map(
    images: Path,
    workspace: Path,
    options: BuildOptions = BuildOptions(),
    known: KnownPoses | None = None,
    progress: ProgressBar = silent,
) -> Build:
    """Build a map from a folder of photos by Structure from Motion.

    Args:
        images: Folder; every image below it is used, or, with known poses, those that have one.
        workspace: Folder for intermediate files; the map reads its features from there.
        options: How to build.
        known: Poses known beforehand: then points are triangulated and nothing else is estimated.
        progress: Told of the long loops.

    Raises:
        InputError: The folder, an image, a mask or the box cannot be used.
        ReconstructionError: The images give no model.
    """
    names = sorted(known.cam_from_world) if known else list_images(images)
    if len(names) < 2:
        raise InputError(f"{images}: holds {len(names)} image; a map needs at least two")
    given_box = read_box(options.box) if options.box else (known.box if known else None)
    extractor = _extractor(options)
    workspace.mkdir(parents=True, exist_ok=True)
    cameras = known.cameras if known else guess_cameras(images, names, options.camera)
    work = BuildWork(
        images=images, names=names, workspace=workspace, cameras=cameras, known=known, progress=progress
    )
    if isinstance(extractor, ModelBuilder):
        parts = extractor.build_model(work, options)
    else:
        parts = _parts_with_keypoints(work, extractor, options)
    info = MapInfo(
        extractor=parts.extractor.name,
        extractor_options=parts.extractor.options,
        box=given_box or estimate_box(parts.model),
        box_source="given" if given_box else "estimated",
        unit=known.unit if known else "unknown",
        origin=f"built from {len(names)} images" + (" with known poses" if known else ""),
    )
    made = Map(
        model=parts.model, features=parts.features, matches=parts.matches, photos=parts.photos, info=info
    )
    return _build(with_global_descriptors(made), names)


def _build(map: Map, names: list[str]) -> Build:
    return Build(map=map, left_out=tuple(name for name in names if name not in map.images))


@dataclass(frozen=True, kw_only=True, eq=False)
class BuildWork:
    """What a model is built from."""

    images: Path
    """Folder of the photos."""

    names: list[str]
    """Names of the photos to use, relative to the folder."""

    workspace: Path
    """Folder for intermediate files."""

    cameras: Mapping[str, pycolmap.Camera]
    """Intrinsics by image name; images with equal `camera_id` share a camera."""

    known: KnownPoses | None
    """Known poses, if any: then points are triangulated and nothing else is estimated."""

    progress: ProgressBar
    """Progress callback."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MapParts:
    """A model and the data that its map stores with it."""

    extractor: Extractor
    """Extractor that the map records for queries."""

    model: pycolmap.Reconstruction
    """The SfM model; keypoint i of an image is row i of its features."""

    features: Mapping[str, Features]
    """Local features by image name."""

    matches: Matches
    """Verified matches by pair of image names."""

    photos: Mapping[str, Image] = field(default_factory=dict)
    """Small photos by image name, for extractors without keypoints."""


@runtime_checkable
class ModelBuilder(Protocol):
    """An extractor that builds the model of a map itself, because it finds no keypoints."""

    def build_model(self, work: BuildWork, options: BuildOptions) -> MapParts:
        """Build a model from photos.

        Raises:
            InputError: A photo, a mask or an option cannot be used.
            ReconstructionError: The images give no model.
        """
        ...


def _parts_with_keypoints(work: BuildWork, extractor: Extractor, options: BuildOptions) -> MapParts:
    output, names = work.workspace / "features.h5", work.names
    features, colors = extract_features(work.images, names, extractor, options.masks, output, work.progress)
    database = _match(work, features, options)
    if work.known:
        poses = work.known.cam_from_world
        model = triangulate(database, names, work.workspace / "sfm", poses, seed=options.seed)
    else:
        model = reconstruct(database, names, work.workspace / "sfm", seed=options.seed)
    put_keypoints(model, features)
    color_points(model, colors)
    matches = verified_matches(database, {i: model.image(i).name for i in model.reg_image_ids()})
    return MapParts(extractor=extractor, model=model, features=features, matches=matches)


def _extractor(options: BuildOptions) -> Extractor:
    wishes: dict = {"max_features": options.max_features, "max_image_size": options.max_image_size}
    return load_extractor(
        options.extractor, {key: value for key, value in wishes.items() if value is not None}
    )


def _match(work: BuildWork, features: FeatureFile, options: BuildOptions) -> Path:
    database = work.workspace / "database.db"
    write_database(database, features, work.cameras)
    names, pairs = list(features), choose_pairs(features, options.pairs, seed=options.seed)
    if (options.extractor, options.matcher) == ("sift", "nearest"):  # COLMAP's own matcher is faster
        match_pairs(database, names, pairs, seed=options.seed, progress=work.progress)
    else:
        matcher = load_matcher(options.matcher, options.extractor)
        matches = match_pairs_with(matcher, features, pairs, work.progress)
        verify_pairs(database, names, matches, seed=options.seed)
    return database
