"""The extractor of maps without keypoints: it matches images as a whole and builds their model."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import GrayImage, Image
from slimsfm.errors import InputError
from slimsfm.features import Features
from slimsfm.features.registry import importing, load_object
from slimsfm.localization.matching import ReferenceMatching
from slimsfm.mapping.build import BuildOptions, BuildWork, MapParts
from slimsfm.mapping.map import Map
from slimsfm.mapping.pairs import PairChoice, Pairs, exhaustive_pairs, sequential_pairs
from slimsfm.mapping.photo_file import shrink_photo
from slimsfm.methods.loftr.image_matching import ImageMatcher, Photo
from slimsfm.methods.loftr.mapping import build_without_keypoints
from slimsfm.methods.loftr.reference_matching import DetectorFreeMatching
from slimsfm.photos import read_image
from slimsfm.weights import find_weights

_FOR_ONEPOSE = "loftr-onepose++"
_MOST_EXHAUSTIVE = 30  # images up to which "auto" matches every pair: networks are slow
_NEIGHBORS = 10
_LEAST_ANGLE_DEG = 10.0  # between viewing directions of neighbors; below it nothing can be triangulated


@dataclass(frozen=True, kw_only=True)
class DetectorFree:
    """Finds no keypoints: LoFTR matches the images themselves."""

    max_image_size: int = 640
    """Shrink larger images before matching so that their longer side has this many pixels."""

    weights: Literal["loftr", "loftr-onepose++"] = "loftr"
    """LoFTR's own weights, or those with which OnePose++ builds its maps. A new map uses the latter if they
    are in the weights folder, so that it also works with the strategy `onepose++`."""

    @property
    def name(self) -> str:
        """Name of the extractor in a map's `map.json`."""
        return "loftr"

    @property
    def options(self) -> dict:
        """Options with which `load_extractor` creates an equal extractor."""
        return asdict(self)

    @property
    def matcher(self) -> ImageMatcher:
        """LoFTR with these options.

        Raises:
            InputError: A package that LoFTR needs is missing.
        """
        with importing(f"extractor {self.name!r}"):
            return load_object("slimsfm.methods.loftr.matcher:Loftr")(**self.options)

    def extract(self, image: Image, mask: GrayImage | None = None) -> Features:  # noqa: ARG002
        """Return no features, with the size of this image."""
        return Features(
            keypoints=np.zeros((0, 2), np.float32),
            descriptors=np.zeros((0, 0), np.float32),
            scores=np.zeros(0, np.float32),
            image_size=(image.shape[1], image.shape[0]),
        )

    def build_model(self, work: BuildWork, options: BuildOptions) -> MapParts:
        """Build a model from photos; see `slimsfm.mapping.build.ModelBuilder`."""
        chosen = replace(self, weights=_FOR_ONEPOSE) if find_weights(_FOR_ONEPOSE) else self
        photos = PhotoFolder(work.images, work.names)
        poses = work.known.cam_from_world if work.known else None
        made = build_without_keypoints(
            photos,
            choose_image_pairs(work.names, options.pairs, poses),
            chosen.matcher,
            work.cameras,
            work.workspace,
            cam_from_world=poses,
            masks=options.masks,
            seed=options.seed,
            progress=work.progress,
        )
        return MapParts(
            extractor=chosen,
            model=made.model,
            features=made.features,
            matches=made.matches,
            photos={name: shrink_photo(photos[name], self.max_image_size) for name in made.features},
        )

    def reference_matching(self, map: Map) -> ReferenceMatching:
        """Match queries with a map's photos; see `slimsfm.localization.matching.WholeImageExtractor`."""
        return DetectorFreeMatching(map, lambda: self.matcher)


class PhotoFolder(Mapping[str, Photo]):
    """Photos of a folder by name, read on access."""

    def __init__(self, folder: Path, names: list[str]) -> None:
        self._folder = folder
        self._names = dict.fromkeys(names)

    def __getitem__(self, name: str) -> Photo:
        if name not in self._names:
            raise KeyError(name)
        return read_image(self._folder / name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def choose_image_pairs(
    names: list[str], choice: PairChoice, cam_from_world: Mapping[str, pycolmap.Rigid3d] | None
) -> Pairs:
    """Choose the pairs of images to match.

    Auto: every pair up to 30 images; above that neighbors by pose if poses are known, otherwise neighbors by
    order of name.

    Raises:
        InputError: `choice` is "similar".
    """
    if choice == "similar":
        raise InputError(
            "pairs of similar images are found by local features, which this extractor does not have; "
            "use `pairs='exhaustive'` or `pairs='sequential'`"
        )
    if choice == "exhaustive" or (choice == "auto" and len(names) <= _MOST_EXHAUSTIVE):
        return exhaustive_pairs(names)
    if choice == "sequential" or cam_from_world is None:
        return sequential_pairs(names)
    return neighboring_pairs({name: cam_from_world[name] for name in names})


def neighboring_pairs(cam_from_world: Mapping[str, pycolmap.Rigid3d]) -> Pairs:
    """Pair each image with nearby images whose viewing direction differs by at least 10 degrees.

    Every second of the 20 nearest images is taken, as in OnePose++ [1], so that some pairs are farther apart.

    References:
        [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation
            without CAD Models, NeurIPS 2022.
    """
    names = sorted(cam_from_world)
    distances = _distances([cam_from_world[name] for name in names])
    found = set()
    for row, name in enumerate(names):
        nearest = np.argsort(distances[row], kind="stable")[: np.isfinite(distances[row]).sum()]
        step = 2 if len(nearest) >= 2 * _NEIGHBORS else 1
        chosen = nearest[::step][:_NEIGHBORS]
        found |= {(min(name, names[other]), max(name, names[other])) for other in chosen.tolist()}
    return sorted(found)


def _distances(cam_from_world: list[pycolmap.Rigid3d]) -> Float64[np.ndarray, "n n"]:
    """Distances between cameras; infinite if their orientations differ by less than the least angle."""
    centers = np.array([pose.inverse().translation for pose in cam_from_world])
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    rotations = np.array([pose.rotation.matrix() for pose in cam_from_world])
    cosines = (np.einsum("aij,bij->ab", rotations, rotations) - 1) / 2
    distances[cosines > np.cos(np.radians(_LEAST_ANGLE_DEG))] = np.inf
    return distances
