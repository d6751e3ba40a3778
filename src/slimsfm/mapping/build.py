"""Build maps from photos by Structure from Motion."""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import pycolmap

from slimsfm.arrays import Image
from slimsfm.errors import InputError, ReconstructionError
from slimsfm.exif import Exif, ignored_values, read_exif, read_orientation
from slimsfm.features import Extractor, Features, load_extractor, load_matcher
from slimsfm.geometry import Box
from slimsfm.mapping.descriptors import with_global_descriptors
from slimsfm.mapping.diagnosis import diagnose
from slimsfm.mapping.extraction import CameraSharing, color_points, extract_features, guess_cameras
from slimsfm.mapping.map import Map, MapInfo
from slimsfm.mapping.masked_photos import AlphaUse, MaskedPhotos, find_photos
from slimsfm.mapping.model import estimate_box, read_box
from slimsfm.mapping.orientation import TurnedFeatures, turned_model
from slimsfm.mapping.pairs import Matches, PairChoice, choose_pairs, match_pairs_with, verify_pairs
from slimsfm.mapping.quality import ModelQuality
from slimsfm.mapping.reconstruction import pick_model, reconstruct
from slimsfm.mapping.sfm import (
    colmap_warnings,
    match_pairs,
    put_keypoints,
    triangulate,
    verified_matches,
    write_database,
)
from slimsfm.mapping.shrinking import ShrunkImages
from slimsfm.mapping.support import measure
from slimsfm.photos import Orientation
from slimsfm.progress import ProgressBar, silent


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """How a map is built from photos."""

    camera: CameraSharing = "auto"
    """Images that share a camera: all (shared), none (per-image), or images of equal size and, by EXIF, equal
    focal length and device (auto). Width and height may be swapped."""

    orientation: Orientation = "upright"
    """Which pixels of the photos to map: turned upright according to EXIF, or as they are stored, as COLMAP
    does. Queries are read alike."""

    pairs: PairChoice = "auto"
    """Pairs of images to match: all (exhaustive), neighbors in order of name (sequential), or images that
    look alike (similar). auto: exhaustive up to 200 images, otherwise sequential and similar; without a
    detector, exhaustive up to 30 images, otherwise by pose if poses are known, else sequential."""

    masks: Path | None = None
    """Folder of masks, IMG.jpg.png or IMG.png for image IMG.jpg as in COLMAP; where a mask is black, no
    features are used."""

    alpha: AlphaUse = "mask"
    """What transparency does: transparent pixels hold no features (mask), or are like any others (ignore)."""

    extractor: str = "sift"
    """Local features, see `slimsfm methods`; loftr matches images without a detector."""

    matcher: str = "nearest"
    """Matcher of the features: nearest, lightglue or superglue."""

    max_image_size: int | None = None
    """Longer side in pixels to which larger images are shrunk before extraction. Default: 1600 for SIFT, 1024
    for learned features, 640 for loftr."""

    max_features: int | None = None
    """Largest number of features per image. Default: 4096 for SIFT, 2048 for learned features."""

    box: Path | None = None
    """File with the object's box: JSON or OnePose's box3d_corners.txt. Estimated by default."""

    model: int = 1
    """Which model to keep if the photos give several: 1 is the largest."""

    seed: int = 0
    """Seed of every random choice."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if self.model < 1:
            raise ValueError(f"model must be at least 1, got {self.model}")


@dataclass(frozen=True, kw_only=True)
class KnownPoses:
    """Known cameras and poses of images; none of them is refined."""

    cameras: Mapping[str, pycolmap.Camera]
    """Intrinsics by image name; images with equal `camera_id` share a camera."""

    cam_from_world: Mapping[str, pycolmap.Rigid3d]
    """Poses by image name."""

    box: Box
    """The object's box in the world frame."""

    unit: str
    """Unit of the world frame, such as "metre"."""


def build_map(
    images: str | Path,
    options: BuildOptions = BuildOptions(),
    *,
    known: KnownPoses | None = None,
    workspace: str | Path | None = None,
    progress: ProgressBar = silent,
) -> Map:
    """Build a map from a folder of photos by Structure from Motion.

    Photos that could not be registered are named in `Map.unregistered`, and what was skipped or ignored in
    `MapInfo.notes`. The map reads its features from disk when they are needed, so that large maps fit into
    memory.

    Args:
        images: Folder. All images in it and its subfolders are used or, with known poses, those with a pose.
        options: How to build.
        known: Known poses: points are triangulated and nothing else is estimated.
        workspace: Folder that keeps the intermediate files: COLMAP's database, model and the features. By
            default a temporary folder that is removed.
        progress: Progress callback.

    Raises:
        InputError: The folder, an image, a mask or the box cannot be used.
        ReconstructionError: The images give no model.
    """
    images = Path(images)
    if known:
        names, notes = sorted(known.cam_from_world), ()
    else:
        found = find_photos(images, options.masks)
        names, notes = list(found.names), found.notes
    if len(names) < 2:
        few = f"{images}: holds {len(names)} image; a map needs at least two"
        raise InputError("; ".join([few, *notes]))
    given_box = read_box(options.box) if options.box else (known.box if known else None)
    extractor = _extractor(options)
    photos = MaskedPhotos(images, names, options.masks, options.alpha, options.orientation)
    exifs = {} if known else {name: read_exif(images / name) for name in names}
    guessed = guess_cameras(exifs, options.camera, options.orientation)
    notes = (*notes, *ignored_values(exifs))
    with _opened(workspace) as folder, colmap_warnings():
        work = BuildWork(
            images=images,
            photos=photos,
            names=names,
            workspace=folder,
            cameras=known.cameras if known else guessed.by_name,
            turned=guessed.turned,
            known=known,
            progress=progress,
        )
        try:
            if isinstance(extractor, ModelBuilder):
                _check_not_turned(work, options)
                parts = extractor.build_model(work, options)
            else:
                parts = _parts_with_keypoints(work, extractor, options)
        except ReconstructionError as error:  # what was skipped may be the reason
            raise ReconstructionError("; ".join([str(error), *notes, *photos.notes])) from error
    quality = measure(parts.model, parts.matches, names)
    info = MapInfo(
        extractor=parts.extractor.name,
        extractor_options=parts.extractor.options,
        box=given_box or estimate_box(parts.model),
        box_source="given" if given_box else "estimated",
        unit=known.unit if known else "unknown",
        origin=f"built from {len(names)} images" + (" with known poses" if known else ""),
        quality=replace(quality, focal_origins=_origins(quality, work.cameras, known)),
        notes=(*notes, *photos.notes, *parts.notes),
        orientation=options.orientation,
        exif_orientations=_exif_orientations(work, exifs) if options.orientation == "upright" else {},
    )
    registered = {parts.model.image(image_id).name for image_id in parts.model.reg_image_ids()}
    made = Map(
        model=parts.model,
        features=parts.features,
        matches=parts.matches,
        photos=parts.photos,
        info=info,
        unregistered=tuple(name for name in names if name not in registered),
    )
    return with_global_descriptors(made)


def _exif_orientations(work: "BuildWork", exifs: Mapping[str, Exif]) -> dict[str, int]:
    tags = {
        name: exifs[name].orientation if exifs else read_orientation(work.images / name)
        for name in work.names
    }
    return {name: tag for name, tag in tags.items() if tag != 1}


def _origins(
    quality: ModelQuality, cameras: Mapping[str, pycolmap.Camera], known: KnownPoses | None
) -> dict[str, str]:
    if known:
        return dict.fromkeys(quality.focal_lengths, "given")
    return {
        name: "EXIF" if cameras[name].has_prior_focal_length else "guessed" for name in quality.focal_lengths
    }


@contextmanager
def _opened(workspace: str | Path | None) -> Iterator[Path]:
    """The workspace, or a temporary one. The open file of features stays readable after it is removed."""
    if workspace is None:
        with tempfile.TemporaryDirectory(prefix="slimsfm-build-") as folder:
            yield Path(folder)
    else:
        Path(workspace).mkdir(parents=True, exist_ok=True)
        yield Path(workspace)


@dataclass(frozen=True, kw_only=True, eq=False)
class BuildWork:
    """What a model is built from."""

    images: Path
    """Folder of the photos."""

    photos: MaskedPhotos
    """The photos with their masks."""

    names: list[str]
    """Names of the photos to use, relative to the folder."""

    workspace: Path
    """Folder for intermediate files."""

    cameras: Mapping[str, pycolmap.Camera]
    """Intrinsics by image name; images with equal `camera_id` share a camera."""

    turned: Mapping[str, pycolmap.Camera]
    """Images taken with the camera of others, held turned by 90°: the camera of the others."""

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

    notes: tuple[str, ...] = ()
    """What the user should know about the choice of the model."""

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
    features, colors = extract_features(work.photos, names, extractor, output, work.progress)
    sideways = TurnedFeatures(features, dict.fromkeys(work.turned, 1))
    shrunk = ShrunkImages.by_extractor(sideways, {**work.cameras, **work.turned}, extractor.options)
    database, sfm = _match(work, features, shrunk, options), work.workspace / "sfm"
    seed, progress = options.seed, work.progress
    notes: tuple[str, ...] = ()
    if work.known:
        poses = work.known.cam_from_world
        model = triangulate(database, names, sfm, poses, seed=seed, progress=progress)
    else:
        try:
            models = reconstruct(database, names, sfm, seed=seed, progress=progress)
        except ReconstructionError as error:
            matches = verified_matches(database, dict(enumerate(names, start=1)))
            reasons = [str(error), diagnose(work.images, names, shrunk.features, matches)]
            raise ReconstructionError(
                f"{work.images}: these {len(names)} photos give no model: {'; '.join(filter(None, reasons))}"
            ) from error
        model, notes = pick_model(models, options.model)
    matches = verified_matches(database, {i: model.image(i).name for i in model.reg_image_ids()})
    shrunk.enlarge(model, known_cameras=work.known is not None)
    if work.turned:
        turns_back = {image.name: -int(image.name in work.turned) for image in model.images.values()}
        model = turned_model(model, turns_back)
        put_keypoints(model, features)
    color_points(model, colors)
    return MapParts(extractor=extractor, model=model, features=features, matches=matches, notes=notes)


def _extractor(options: BuildOptions) -> Extractor:
    wanted: dict = {"max_features": options.max_features, "max_image_size": options.max_image_size}
    return load_extractor(
        options.extractor, {key: value for key, value in wanted.items() if value is not None}
    )


def _match(
    work: BuildWork, features: Mapping[str, Features], shrunk: ShrunkImages, options: BuildOptions
) -> Path:
    database = work.workspace / "database.db"
    write_database(database, shrunk.features, shrunk.cameras)
    names, pairs = list(features), choose_pairs(features, options.pairs, seed=options.seed)
    if (options.extractor, options.matcher) == ("sift", "nearest"):  # COLMAP's own matcher is faster
        match_pairs(database, names, pairs, seed=options.seed, progress=work.progress)
    else:
        matcher = load_matcher(options.matcher, options.extractor)
        matches = match_pairs_with(matcher, features, pairs, work.progress)
        verify_pairs(database, names, matches, seed=options.seed, progress=work.progress)
    return database


def _check_not_turned(work: BuildWork, options: BuildOptions) -> None:
    if work.turned and options.camera == "shared":
        raise InputError(
            f"{min(work.turned)}: width and height are swapped, and without a detector such images cannot "
            "share a camera with the others; use `camera='auto'`"
        )
