"""The map: an SfM model with local features and the object's box."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Float32, UInt8
from scipy.sparse import csr_array

from slimsfm.arrays import Descriptors, Ids, Image, IndexPairs, Mask, Points3D
from slimsfm.errors import MapError
from slimsfm.features import Features, NearestOptions, shrink_factor
from slimsfm.features.registry import descriptor_metric_of, finds_keypoints
from slimsfm.geometry import Box
from slimsfm.lenses import camera_fault
from slimsfm.mapping.cameras import MapCamera, distinct_cameras
from slimsfm.mapping.extent import box_fault, distance_fault, extent_fault
from slimsfm.mapping.info import MapInfo

MapKind = Literal["full", "images", "points", "images and points"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Keypoints of an image that observe points of the map."""

    rows: Ids
    """Rows of the image's features, ascending."""

    points: Ids
    """Row of the observed point in `Map.points3D_in_world`, per keypoint."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointDescriptors:
    """Points of a map for direct matching; a point has a row for each of its appearances."""

    points: Ids
    """Rows of the points in `Map.points3D_in_world`, ascending; repeated for each further descriptor."""

    descriptors: Descriptors
    """One appearance of a point each, of unit length."""

    directions: Float32[np.ndarray, "n 3"] | None = None
    """Mean of the unit vectors towards a point's cameras; short if they differ much. None in older maps."""

    distinct: Mask | None = None
    """Whether a point looks unlike all others of the full map; else it is weak evidence. None in old maps."""

    sizes: Float32[np.ndarray, " n"] | None = None
    """Size of the pattern of each point, in map units: scale in pixels times depth over focal length. None in
    older maps, and if the extractor estimates no scales."""

    def of(self, points: Ids) -> "PointDescriptors":
        """All descriptors of some points."""
        return self[np.flatnonzero(np.isin(self.points, points))]

    @cached_property
    def firsts(self) -> Ids:
        """The first row of each point."""
        return np.flatnonzero(np.diff(self.points, prepend=-1))

    def __getitem__(self, rows: Ids) -> "PointDescriptors":
        """Select descriptors by row, in this order."""
        return PointDescriptors(
            points=self.points[rows],
            descriptors=self.descriptors[rows],
            directions=None if self.directions is None else self.directions[rows],
            distinct=None if self.distinct is None else self.distinct[rows],
            sizes=None if self.sizes is None else self.sizes[rows],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class GlobalDescriptors:
    """Global descriptors (VLAD) of the reference images, which rank them by similarity to a query."""

    vocabulary: Float32[np.ndarray, "words d"]
    """Cluster centers of local descriptors, see `features.nearest`."""

    descriptors: Float32[np.ndarray, "images values"]
    """Global descriptor per reference image in order of name, of unit length."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Map:
    """Everything that localization needs. Maps are immutable."""

    model: pycolmap.Reconstruction
    """The SfM model; keypoint i of an image is row i of its features."""

    features: Mapping[str, Features]
    """Local features by image name; may be read from disk on access. Empty in a map for direct matching only:
    its images have poses but no keypoints, and its points have no tracks."""

    point_descriptors: PointDescriptors | None = None
    """Descriptors for direct matching; None if they have to be computed from `features`."""

    matches: Mapping[tuple[str, str], IndexPairs] = field(default_factory=dict)
    """Verified matches by pair of image names; may be empty."""

    photos: Mapping[str, Image] = field(default_factory=dict)
    """Shrunk reference photos by image name; only in maps built without a detector."""

    global_descriptors: GlobalDescriptors | None = None
    """Global descriptors for retrieval; None if they have to be computed from `features`."""

    info: MapInfo
    """Extractor, box, unit and origin."""

    unregistered: tuple[str, ...] = ()
    """Names of the photos given to `build_map` that could not be registered; not stored on disk."""

    @property
    def kind(self) -> MapKind:
        """Which parts the map holds: "full", or what it was reduced to.

        "points" have descriptors for direct matching. "images" have features, and some points are observed by
        a single image, which SfM never reconstructs.
        """
        if self.point_descriptors is not None:
            return "images and points" if self.features else "points"
        tracks = (point.track.length() for point in self.model.points3D.values())
        return "images" if min(tracks, default=2) < 2 else "full"

    def describe(self) -> str:
        """Kind and size of the map: "200 points for direct matching, reduced from 29 images (...)"."""
        images = f"{len(self.images)} image{'s' * (len(self.images) != 1)}"
        if self.kind == "points":
            points = f"{len(self.point3D_ids)} point{'s' * (len(self.point3D_ids) != 1)}"
            return f"{points} for direct matching, reduced from {images} ({self.info.origin})"
        parts = f"{images} with {len(self.point3D_ids)} points"
        if self.kind == "full":
            return f"{parts} ({self.info.origin})"
        if self.point_descriptors is not None:
            parts += f", {len(self.point_descriptors.firsts)} of them for direct matching"
        return f"{parts}, reduced from a larger map ({self.info.origin})"

    @property
    def is_for_direct_matching(self) -> bool:
        """Whether the map holds points for direct matching but no image features."""
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
        """The object's box in the map's frame, `info.box`."""
        return self.info.box

    @cached_property
    def images(self) -> dict[str, pycolmap.Image]:
        """The reference images (images with a pose) by name, sorted."""
        found = [self.model.image(image_id) for image_id in self.model.reg_image_ids()]
        return {image.name: image for image in sorted(found, key=lambda image: image.name)}

    @cached_property
    def cameras(self) -> tuple[MapCamera, ...]:
        """The cameras of the reference images that differ; equal ones under several ids count once."""
        ids = {image.camera_id for image in self.images.values()}
        cameras = {camera_id: self.model.camera(camera_id) for camera_id in ids}
        return distinct_cameras(self.images.values(), cameras, self.info.devices, self.info.exif_orientations)

    def camera(self, name: str) -> pycolmap.Camera:
        """The camera of a reference image."""
        return self.model.camera(self.images[name].camera_id)

    def shrink_factor(self, name: str) -> float:
        """Pixels of a reference image per pixel in which its features were found; 1 where that is unknown."""
        camera = self.camera(name)
        return shrink_factor(self.info.extractor_options, camera.width, camera.height)

    @cached_property
    def point3D_ids(self) -> Ids:
        """Ids of the points, ascending: the order of all arrays of points."""
        return np.array(sorted(self.model.point3D_ids()), dtype=np.int64)

    @cached_property
    def points3D_in_world(self) -> Points3D:
        """Positions of the points in the map's frame."""
        points = self.model.points3D
        return np.array([points[i].xyz for i in self.point3D_ids], np.float64).reshape(-1, 3)

    @cached_property
    def colors(self) -> UInt8[np.ndarray, "n 3"]:
        """Colors of the points, RGB."""
        points = self.model.points3D
        return np.array([points[i].color for i in self.point3D_ids], np.uint8).reshape(-1, 3)

    @cached_property
    def observations(self) -> dict[str, Observations]:
        """The observations of each reference image by name, sorted."""
        return {name: self._observations(image) for name, image in self.images.items()}

    def _observations(self, image: pycolmap.Image) -> Observations:
        rows = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        points2D = image.points2D
        ids = np.array([points2D[row].point3D_id for row in rows], dtype=np.int64)
        return Observations(rows=rows, points=np.searchsorted(self.point3D_ids, ids))

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the extractor, box, points, poses, cameras, observations and matched pairs."""
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
        """The camera of all reference images, or None if they have several that differ."""
        return self.cameras[0].camera if len(self.cameras) == 1 else None


def observed(map: Map) -> csr_array:
    """Boolean matrix of shape [images, points]: whether an image observes a point."""
    points = [np.unique(seen.points) for seen in map.observations.values()]
    columns = np.concatenate(points)
    starts = np.concatenate([[0], np.cumsum([len(one) for one in points])])
    return csr_array(
        (np.ones(len(columns), bool), columns, starts), shape=(len(points), len(map.point3D_ids))
    )


def check_map(map: Map) -> None:
    """Check that the parts of a map belong together, and that it may be of a real place.

    Raises:
        MapError: The map has no reference image or no point, or lacks the features of an image; a camera is
            impossible, or points, cameras and box have no extent or are too far away.
    """
    if not map.images or not len(map.point3D_ids):
        raise MapError(
            f"the map has {len(map.images)} images and {len(map.point3D_ids)} points; it needs both"
        )
    if fault := _fault(map):
        raise MapError(f"the map cannot be right: {fault}; build or import it again")
    if map.is_for_direct_matching:
        return
    for name in map.images:
        if name not in map.features:
            raise MapError(f"the map has no features of its image {name!r}")


def _fault(map: Map) -> str | None:
    for camera_id in sorted({image.camera_id for image in map.images.values()}):
        if fault := camera_fault(map.model.camera(camera_id)):
            return f"camera {camera_id} is impossible: {fault}"
    cameras = np.array([image.cam_from_world().translation for image in map.images.values()])
    return (
        distance_fault("cameras", cameras)
        or extent_fault("points", map.points3D_in_world)
        or box_fault(map.box, map.points3D_in_world)
    )


def check_has_features(map: Map) -> None:
    """Check that a map has image features.

    Raises:
        MapError: The map is for direct matching only.
    """
    if map.is_for_direct_matching:
        raise MapError(
            "the map is for direct matching alone: it holds points but no image features; "
            "use the map that it was reduced from"
        )


def check_num_features(image: pycolmap.Image, count: int) -> None:
    """Check that an image of a model has `count` keypoints, one per feature.

    Raises:
        MapError: The numbers differ.
    """
    if count != image.num_points2D():
        raise MapError(
            f"image {image.name!r} has {image.num_points2D()} keypoints in the model "
            f"but {count} in the features"
        )
