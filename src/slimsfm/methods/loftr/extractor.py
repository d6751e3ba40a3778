"""The extractor of maps without keypoints: it matches images as a whole and builds their model."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pycolmap
from jaxtyping import Float64
from scipy.spatial import KDTree

from slimsfm.arrays import Descriptors, GrayImage, Ids, Image, Points2D
from slimsfm.errors import InputError
from slimsfm.features import Features, unit_rows
from slimsfm.features.registry import importing, load_object
from slimsfm.files import inside
from slimsfm.localization.matching import ReferenceMatching
from slimsfm.localization.strategy import PointMatches, Query, Target
from slimsfm.mapping.build import BuildOptions, BuildWork, MapParts
from slimsfm.mapping.io import shrink_photo
from slimsfm.mapping.map import Map
from slimsfm.mapping.pairs import PairChoice, Pairs, exhaustive_pairs, sequential_pairs
from slimsfm.methods.loftr.cells import EncodedImage, ImageMatcher, Photo
from slimsfm.methods.loftr.mapping import build_without_keypoints
from slimsfm.photos import Orientation, read_photo
from slimsfm.weights import find_weights

_CACHED = 32  # encoded reference photos kept in memory: 45 MB each at 640 x 480
_DESCRIBED = 2048  # most cells that describe a whole query


class _Reference(NamedTuple):
    """An encoded reference photo and its observations."""

    encoded: EncodedImage
    keypoints: Points2D  # pixels of the photo, which may be smaller than the image that was mapped
    points: Ids


class DetectorFreeMatching:
    """Matches queries with the reference photos of one map, numbered in order of name.

    When a cell of a photo matches a cell of the query, each keypoint in it that observes a point is aligned
    with the query separately. The result is the pixel where the point is seen, not the center of the cell.
    """

    def __init__(self, map: Map, load_matcher: Callable[[], ImageMatcher]) -> None:
        """Prepare matching.

        Args:
            map: A map with photos.
            load_matcher: Loads the matcher with which the map was built.

        Raises:
            InputError: The map has no photos, or a package that the matcher needs is missing.
        """
        if set(map.images) - set(map.photos):
            raise InputError(
                "the map has no photos, which matching without a detector needs; "
                f"build it with the extractor {map.info.extractor}"
            )
        self._map = map
        self._names = tuple(map.images)
        self._matcher = load_matcher()
        self._reference = lru_cache(_CACHED)(self._read)
        self._last: tuple[Photo, EncodedImage] | None = None

    def match(self, pairs: Sequence[tuple[Query, int]], strongest: int | None) -> list[PointMatches]:  # noqa: ARG002
        """Match queries with reference photos.

        Raises:
            InputError: A query has no image.
        """
        return [self._match(query, row) for query, row in pairs]

    def _match(self, query: Query, row: int) -> PointMatches:
        seen, reference = self._encoded(query), self._reference(row)
        cells = self._matcher.match_cells(reference.encoded, seen)
        if not len(cells) or not len(reference.points):
            return _found(np.zeros((0, 2)), reference.points[:0])
        half = reference.encoded.cell_px / 2
        distances, nearest = KDTree(cells.points2D_1).query(
            reference.keypoints, p=np.inf, distance_upper_bound=np.nextafter(half, np.inf)
        )
        rows = np.flatnonzero(np.isfinite(distances))
        keypoints, cell = reference.keypoints[rows], np.asarray(nearest)[rows]
        off = (keypoints - cells.points2D_1[cell]) * (seen.cell_px / reference.encoded.cell_px)
        exact = self._matcher.align(reference.encoded, seen, keypoints, cells.points2D_2[cell] + off)
        return _found(exact * (query.camera.width / seen.image_size[0]), reference.points[rows])

    def target(self, row: int) -> Target:
        """Descriptors of the observations of a reference image, and their points."""
        name = self._names[row]
        seen = self._map.observations[name]
        return unit_rows(self._map.features[name].descriptors[seen.rows]), seen.points

    def describe(self, query: Query) -> Descriptors:
        """Describe the cells of a query, or an evenly spaced part of them, for image retrieval.

        Raises:
            InputError: The query has no image.
        """
        seen = self._encoded(query)
        sides = (np.arange(seen.cell_px / 2, side, seen.cell_px) for side in seen.image_size)
        cells = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
        return unit_rows(self._matcher.describe(seen, cells[:: -(-len(cells) // _DESCRIBED)]))

    def _read(self, row: int) -> _Reference:
        name = self._names[row]
        seen, encoded = self._map.observations[name], self._matcher.encode(self._map.photos[name])
        keypoints = self._map.features[name].keypoints[seen.rows].astype(np.float64)
        shrinking = np.array(encoded.image_size) / (
            self._map.camera(name).width,
            self._map.camera(name).height,
        )
        return _Reference(encoded=encoded, keypoints=keypoints * shrinking, points=seen.points)

    def _encoded(self, query: Query) -> EncodedImage:
        """Encode the query. The last one is kept, because it is matched with several references in turn."""
        if query.image is None:
            raise InputError(
                "matching without a detector needs the query's image, but only its features are given"
            )
        last = self._last
        if last is None or last[0] is not query.image:
            self._last = last = (query.image, self._matcher.encode(query.image))
        return last[1]


def _found(points2D: Points2D, points: Ids) -> PointMatches:
    return PointMatches(
        keypoints=np.arange(len(points), dtype=np.int64), points=points, references=1, points2D=points2D
    )


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
        photos = PhotoFolder(work.images, work.names, options.orientation)
        poses = work.known.cam_from_world if work.known else None
        made = build_without_keypoints(
            photos,
            choose_image_pairs(work.names, options.pairs, poses),
            chosen.matcher,
            work.cameras,
            work.workspace,
            cam_from_world=poses,
            masks=_masks(work),
            number=options.model,
            split=options.camera == "auto",
            seed=options.seed,
            progress=work.progress,
        )
        return MapParts(
            extractor=chosen,
            model=made.model,
            features=made.features,
            matches=made.matches,
            picked=made.picked,
            photos={name: shrink_photo(photos[name], self.max_image_size) for name in made.features},
        )

    def reference_matching(self, map: Map) -> ReferenceMatching:
        """Match queries with a map's photos; see `slimsfm.localization.matching.WholeImageExtractor`."""
        return DetectorFreeMatching(map, lambda: self.matcher)


def _masks(work: BuildWork) -> dict[str, GrayImage]:
    read = ((name, work.photos.read(name).mask) for name in work.names)
    return {name: mask for name, mask in read if mask is not None}


class PhotoFolder(Mapping[str, Photo]):
    """Photos of a folder by name, read on access."""

    def __init__(self, folder: Path, names: list[str], orientation: Orientation = "upright") -> None:
        self._folder = folder
        self._orientation: Orientation = orientation
        self._names = dict.fromkeys(names)

    def __getitem__(self, name: str) -> Photo:
        if name not in self._names:
            raise KeyError(name)
        return read_photo(inside(self._folder, name), self._orientation, warn=False).image

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
