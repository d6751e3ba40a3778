"""The map: an SfM model, its local features and the object's box."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pycolmap
from jaxtyping import Float32, UInt8
from scipy.sparse import csr_array

from slimsfm.arrays import Descriptors, Ids, Image, IndexPairs, Mask, Points3D
from slimsfm.errors import MapError
from slimsfm.features import Features, NearestOptions
from slimsfm.features.registry import descriptor_metric_of, finds_keypoints
from slimsfm.geometry import Box


@dataclass(frozen=True, kw_only=True, eq=False)
class MapInfo:
    """What a map says of itself, in its `map.json`."""

    extractor: str
    """Name of the extractor whose features the map holds; queries are extracted with the same."""

    extractor_options: dict = field(default_factory=dict)
    """Options of the extractor."""

    box: Box
    """The object's box in the map's frame."""

    box_source: str
    """Where the box comes from: "given" or "estimated"."""

    unit: str = "unknown"
    """The unit of the map's frame: "metre", or "unknown" where SfM left the scale open."""

    origin: str
    """A sentence on where the map came from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Which keypoints of an image see which points of the map."""

    rows: Ids
    """Rows of the image's features, ascending."""

    points: Ids
    """For each of them the row of the point in `Map.points3D_in_world`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointDescriptors:
    """Points of a map that queries are matched against directly, each with one descriptor."""

    points: Ids
    """Rows of the points in `Map.points3D_in_world`, ascending."""

    descriptors: Descriptors
    """For each of them its descriptor."""

    directions: Float32[np.ndarray, "n 3"] | None = None
    """For each of them where it was seen from: the mean of the unit vectors towards the cameras that observe
    it, the shorter the more these differ; None in maps of old, which tell nothing of it."""

    distinct: Mask | None = None
    """Which of them look like no other point of the full map; the others prove little of a pose. None in maps
    of old."""

    def __getitem__(self, rows: Ids) -> "PointDescriptors":
        """Some of them, in this order."""
        return PointDescriptors(
            points=self.points[rows],
            descriptors=self.descriptors[rows],
            directions=None if self.directions is None else self.directions[rows],
            distinct=None if self.distinct is None else self.distinct[rows],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class GlobalDescriptors:
    """What the reference images look like as a whole."""

    vocabulary: Float32[np.ndarray, "words d"]
    """The words that global descriptors are made by, see `features.vlad`."""

    descriptors: Float32[np.ndarray, "images values"]
    """For each reference image, in order of name, its global descriptor, of unit length."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Map:
    """Everything that a query is localized against. Nothing in it changes."""

    model: pycolmap.Reconstruction
    """The SfM model; keypoint i of an image is row i of its features."""

    features: Mapping[str, Features]
    """Local features by image name; may be read from disk on access. Empty in a map for direct matching
    alone: its images have poses but no keypoints, its points no tracks."""

    point_descriptors: PointDescriptors | None = None
    """What queries are matched against directly; None where it has to be made from `features`."""

    matches: Mapping[tuple[str, str], IndexPairs] = field(default_factory=dict)
    """Verified matches by pair of image names; empty where the map has none."""

    photos: Mapping[str, Image] = field(default_factory=dict)
    """The reference photos by image name, small; just in maps built without a detector."""

    global_descriptors: GlobalDescriptors | None = None
    """By what reference images that resemble a query are found; None where it has to be made anew."""

    info: MapInfo
    """Extractor, box, unit and origin."""

    @property
    def is_for_direct_matching(self) -> bool:
        """Whether there are points to match but no image features."""
        return not self.features and self.point_descriptors is not None

    @property
    def descriptor_metric(self) -> NearestOptions:
        """How the map's descriptors compare: which nearest neighbors count as matches."""
        return descriptor_metric_of(self.info.extractor)

    @property
    def has_keypoints(self) -> bool:
        """Whether the map's extractor finds keypoints; otherwise images are matched as a whole."""
        return finds_keypoints(self.info.extractor)

    @property
    def box(self) -> Box:
        """The object's box in the map's frame."""
        return self.info.box

    @cached_property
    def images(self) -> dict[str, pycolmap.Image]:
        """The reference images, those with a pose, by name in sorted order."""
        found = [self.model.image(image_id) for image_id in self.model.reg_image_ids()]
        return {image.name: image for image in sorted(found, key=lambda image: image.name)}

    def camera(self, name: str) -> pycolmap.Camera:
        """The camera of a reference image."""
        return self.model.camera(self.images[name].camera_id)

    @cached_property
    def point3D_ids(self) -> Ids:
        """Ids of the points, ascending: the order of every array of points."""
        return np.array(sorted(self.model.point3D_ids()), dtype=np.int64)

    @cached_property
    def points3D_in_world(self) -> Points3D:
        """Positions of the points."""
        points = self.model.points3D
        return np.array([points[i].xyz for i in self.point3D_ids], np.float64).reshape(-1, 3)

    @cached_property
    def colors(self) -> UInt8[np.ndarray, "n 3"]:
        """RGB of the points."""
        points = self.model.points3D
        return np.array([points[i].color for i in self.point3D_ids], np.uint8).reshape(-1, 3)

    @cached_property
    def observations(self) -> dict[str, Observations]:
        """The observations of each reference image, by name in sorted order."""
        return {name: self._observations(image) for name, image in self.images.items()}

    def _observations(self, image: pycolmap.Image) -> Observations:
        rows = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        points2D = image.points2D
        ids = np.array([points2D[row].point3D_id for row in rows], dtype=np.int64)
        return Observations(rows=rows, points=np.searchsorted(self.point3D_ids, ids))

    @cached_property
    def fingerprint(self) -> str:
        """Equal for maps of equal extractor, box, points, poses, cameras, observations and matched pairs."""
        digest = hashlib.sha256(repr((self.info.extractor, self.info.extractor_options)).encode())
        for values in (self.box.corners, self.point3D_ids, self.points3D_in_world):
            digest.update(values.tobytes())
        digest.update(repr(sorted(self.matches)).encode())
        for name, image in self.images.items():
            digest.update(name.encode())
            digest.update(image.cam_from_world().matrix().tobytes())
            digest.update(self.camera(name).model_name.encode() + self.camera(name).params.tobytes())
            digest.update(self.observations[name].rows.tobytes())
            digest.update(self.observations[name].points.tobytes())
        return digest.hexdigest()

    @property
    def shared_camera(self) -> pycolmap.Camera | None:
        """The camera of all reference images, or None where they have several."""
        ids = {image.camera_id for image in self.images.values()}
        return self.model.camera(ids.pop()) if len(ids) == 1 else None


def observed(map: Map) -> csr_array:
    """Which images observe which points: a boolean matrix [images, points]."""
    points = [np.unique(seen.points) for seen in map.observations.values()]
    columns = np.concatenate(points)
    starts = np.concatenate([[0], np.cumsum([len(one) for one in points])])
    return csr_array(
        (np.ones(len(columns), bool), columns, starts), shape=(len(points), len(map.point3D_ids))
    )


def check_map(map: Map) -> None:
    """Make sure that a map's parts fit each other.

    Raises:
        MapError: There is no reference image or point, or an image's features are missing.
    """
    if not map.images or not len(map.point3D_ids):
        raise MapError(
            f"the map has {len(map.images)} images and {len(map.point3D_ids)} points; it needs both"
        )
    if map.is_for_direct_matching:
        return
    for name in map.images:
        if name not in map.features:
            raise MapError(f"the map has no features of its image {name!r}")


def check_has_features(map: Map) -> None:
    """Make sure that images can be matched with those of a map.

    Raises:
        MapError: The map was made for direct matching alone.
    """
    if map.is_for_direct_matching:
        raise MapError(
            "the map is for direct matching alone: it holds points but no image features; "
            "use the map that it was made of"
        )


def check_count(image: pycolmap.Image, count: int) -> None:
    """Make sure that an image has as many features as keypoints in the model.

    Raises:
        MapError: It has not.
    """
    if count != image.num_points2D():
        raise MapError(
            f"image {image.name!r} has {image.num_points2D()} keypoints in the model "
            f"but {count} in the features"
        )
