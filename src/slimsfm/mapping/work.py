"""What a model is built from, and what building it gives."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import pycolmap

from slimsfm.arrays import Image
from slimsfm.features import Extractor, Features
from slimsfm.geometry import Box
from slimsfm.lenses import camera_fault
from slimsfm.mapping.blocks import Workers
from slimsfm.mapping.choice import PickedModel
from slimsfm.mapping.conventions import PoseConvention
from slimsfm.mapping.extraction import CameraSharing
from slimsfm.mapping.masked_photos import AlphaUse, MaskedPhotos
from slimsfm.mapping.pairs import Matches, PairChoice
from slimsfm.mapping.workspace import Workspace
from slimsfm.photos import Orientation
from slimsfm.progress import ProgressBar
from slimsfm.weights import current_runtime


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
    look alike (similar). auto: exhaustive up to 200 images, otherwise sequential and similar, and above 60
    images without pairs that are no neighbors and whose largest SIFT features do not match; without a
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

    strict: bool = False
    """Stop at the first photo that cannot be read, instead of skipping it."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if self.model < 1:
            raise ValueError(f"model must be at least 1, got {self.model}")


@dataclass(frozen=True, kw_only=True)
class KnownPoses:
    """Known cameras and poses of images. Cameras are not refined, poses only if asked for."""

    cameras: Mapping[str, pycolmap.Camera]
    """Intrinsics by image name; images with equal `camera_id` share a camera."""

    cam_from_world: Mapping[str, pycolmap.Rigid3d]
    """Poses by image name."""

    box: Box | None = None
    """The object's box in the world frame; None: estimated from the points."""

    unit: str
    """Unit of the world frame, such as "metre"."""

    refine: bool = False
    """Adjust the poses to the matches, in their frame and unit."""

    convention: PoseConvention | None = None
    """How the matrices of a file were read, which the matches are asked to confirm; None: beyond doubt."""

    source: str = "the known poses"
    """Where the poses come from, for messages."""

    notes: tuple[str, ...] = ()
    """Sentences on what was guessed, and on photos without a pose."""

    def __post_init__(self) -> None:
        for name, camera in self.cameras.items():
            if fault := camera_fault(camera):
                raise ValueError(f"cameras must be possible, but that of {name!r} is not: {fault}")


def build_key(
    images: Path,
    names: list[str],
    photos: MaskedPhotos,
    extractor: Extractor,
    options: BuildOptions,
    known: KnownPoses | None,
) -> dict[str, Any]:
    """All that features and matches depend on: photos and masks, options, known poses, and versions."""
    chosen = {field.name: getattr(options, field.name) for field in fields(options)}
    later = ("box", "model", "strict", "masks")  # masks count as files
    return {
        "versions": [version("slimsfm"), pycolmap.__version__, cv2.__version__],
        "images": [os.path.realpath(images), *names],
        **files_key(photos, names, options.extractor, options.matcher),
        "extractor": [extractor.name, repr(extractor.options)],
        "options": {name: value for name, value in chosen.items() if name not in later},
        "known": known and [[name, _text(known, name)] for name in names if name in known.cameras],
    }


def files_key(photos: MaskedPhotos, names: list[str], extractor: str, matcher: str) -> dict[str, list]:
    """The files that features and matches depend on: photos, masks and weights."""
    files = [path for name in names for path in photos.files_of(name)]
    return {
        "files": [[str(path), *_stamp(path)] for path in files],
        "networks": _networks(extractor, matcher),
    }


def _networks(extractor: str, matcher: str) -> list:
    """Device and weight files of learned methods; empty if none is used."""
    if (extractor, matcher) == ("sift", "nearest"):
        return []
    runtime = current_runtime()
    files = sorted(runtime.weights.iterdir()) if runtime.weights else []
    return [runtime.device, *([path.name, *_stamp(path)] for path in files)]


def _stamp(path: Path) -> tuple[int, int]:
    """Size and time of modification of a file; zeros if it cannot be read."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_size, found.st_mtime_ns


def _text(known: KnownPoses, name: str) -> str:
    pose = known.cam_from_world[name].matrix().tolist()
    return f"{known.cameras[name].todict()} {pose}"


@dataclass(frozen=True, kw_only=True, eq=False)
class BuildWork:
    """What a model is built from."""

    images: Path
    """Folder of the photos."""

    photos: MaskedPhotos
    """The photos with their masks."""

    names: list[str]
    """Names of the photos to use, relative to the folder; all of them can be read."""

    workspace: Workspace
    """Intermediate files."""

    cameras: Mapping[str, pycolmap.Camera]
    """Intrinsics by image name; images with equal `camera_id` share a camera."""

    turned: Mapping[str, pycolmap.Camera]
    """Images taken with the camera of others, held turned by 90°: the camera of the others."""

    known: KnownPoses | None
    """Known poses, if any: then points are triangulated and nothing else is estimated."""

    workers: Workers
    """Who matches pairs of images."""

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

    picked: PickedModel | None = None
    """The model as it was picked, with its support and what to say about it; None with known poses."""

    notes: tuple[str, ...] = ()
    """What else to say about the model."""

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
