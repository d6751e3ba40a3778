"""Photos to map."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from slimsfm.errors import InputError
from slimsfm.features import Extractor, load_extractor, load_matcher
from slimsfm.features.store import FeatureFile
from slimsfm.geometry import Box
from slimsfm.mapping.appearance import with_appearance
from slimsfm.mapping.box import estimate_box, read_box
from slimsfm.mapping.cameras import CameraSharing, guess_cameras
from slimsfm.mapping.extraction import color_points, extract_features
from slimsfm.mapping.map import Map, MapInfo
from slimsfm.mapping.pair_matching import match_pairs_with, verify_pairs
from slimsfm.mapping.pairs import PairChoice, choose_pairs
from slimsfm.mapping.sfm import match_pairs, reconstruct, triangulate, verified_matches, write_database
from slimsfm.photos import list_images
from slimsfm.progress import ProgressBar, silent


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """How a map is built from photos."""

    camera: CameraSharing = "auto"
    """Which images share a camera: all, none, or (auto) those of equal size and EXIF focal length."""

    pairs: PairChoice = "auto"
    """Images to match: each with every other one, with its neighbours in order of name, or with those that
    look alike. Auto: exhaustive up to 200 images, above that sequential and similar."""

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
    features, colors = extract_features(
        images, names, extractor, options.masks, workspace / "features.h5", progress
    )
    database = _match(workspace, features, cameras, options, progress)
    if known:
        model = triangulate(database, names, workspace / "sfm", known.cam_from_world, seed=options.seed)
    else:
        model = reconstruct(database, names, workspace / "sfm", seed=options.seed)
    color_points(model, colors)
    info = MapInfo(
        extractor=extractor.name,
        extractor_options=extractor.options,
        box=given_box or estimate_box(model),
        box_source="given" if given_box else "estimated",
        unit=known.unit if known else "unknown",
        origin=f"built from {len(names)} images" + (" with known poses" if known else ""),
    )
    matches = verified_matches(database, {i: model.image(i).name for i in model.reg_image_ids()})
    made = Map(model=model, features=features, matches=matches, info=info)
    return _build(with_appearance(made), names)


def _build(map: Map, names: list[str]) -> Build:
    return Build(map=map, left_out=tuple(name for name in names if name not in map.images))


def _extractor(options: BuildOptions) -> Extractor:
    wishes = {"max_features": options.max_features, "max_image_size": options.max_image_size}
    return load_extractor(
        options.extractor, {key: value for key, value in wishes.items() if value is not None}
    )


def _match(
    workspace: Path,
    features: FeatureFile,
    cameras: Mapping[str, pycolmap.Camera],
    options: BuildOptions,
    progress: ProgressBar,
) -> Path:
    database = workspace / "database.db"
    write_database(database, features, cameras)
    names, pairs = list(features), choose_pairs(features, options.pairs, seed=options.seed)
    if (options.extractor, options.matcher) == ("sift", "nearest"):  # COLMAP's own matcher is faster
        match_pairs(database, names, pairs, seed=options.seed, progress=progress)
    else:
        matches = match_pairs_with(
            load_matcher(options.matcher, options.extractor), features, pairs, progress
        )
        verify_pairs(database, names, matches, seed=options.seed)
    return database
