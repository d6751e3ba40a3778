"""The strategy `onepose`: matches the keypoints of a query with all points of a map by a network [1].

The network was trained on square crops filled by the object, both of reference images and of queries.
Reference images locate the object in the query first; then the pose does, by projecting its box. Crops have
the size at which the references show the object, because SuperPoint's descriptors match best at equal scale.

References:
    [1] Sun, Wang, Zhang, He, Zhao, Zhang and Zhou, OnePose: One-Shot Object Pose Estimation without CAD
        Models, CVPR 2022.
"""

from typing import NamedTuple

import numpy as np
import pycolmap
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from slimsfm.arrays import Descriptors, Ids, Points2D, evenly_spaced
from slimsfm.errors import MapError
from slimsfm.features import Extractor, unit_rows
from slimsfm.localization.matching import matching_with
from slimsfm.localization.strategies import Direct
from slimsfm.localization.strategy import MatchingOptions, PointMatches, Query, Rounds, Target
from slimsfm.mapping.extractor import extractor_of
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.methods.onepose.crop import (
    CROP_PX,
    LOOKED_AT,
    FoundPoints,
    LocatedObject,
    Region,
    RegionVote,
    box_region,
    crop_region,
    locate_object,
    region_by_matches,
)
from slimsfm.methods.onepose.network import DIMENSIONS, THRESHOLD, GraphAttentionMatcher, mutual_matches
from slimsfm.methods.onepose.points import in_box, prepare_points
from slimsfm.networks.loading import choose_device, load_network, matcher_state

_EXTRACTOR = "superpoint"
_FEWEST = 2  # keypoints and points: the network normalizes over them
_SMALLEST, _LARGEST = 64, 1024  # pixels along a side of a crop


class OnePoseStrategy:
    """Matches by attention. O(keypoints x points) per look, two looks per query."""

    def __init__(
        self,
        map: Map,
        options: MatchingOptions = MatchingOptions(),
        *,
        extractor: Extractor | None = None,
        threshold: float = THRESHOLD,
    ) -> None:
        """Describe the points and load the network.

        Args:
            map: A map of SuperPoint features.
            options: How reference images are matched to locate the object.
            extractor: Extracts the features of crops; by default the map's own extractor.
            threshold: Least confidence of a match.

        Raises:
            MapError: The map does not hold SuperPoint features.
            InputError: Weights are missing, or the matcher does not support the map's features.
        """
        _check_map(map)
        self._box = map.box
        self._threshold = threshold
        self._network = load_network(GraphAttentionMatcher(), "onepose", matcher_state)
        self._extractor = extractor or extractor_of(map)
        prepared = prepare_points(map)
        self._points = prepared.points
        leaves = prepared.leaves.reshape(-1, DIMENSIONS)
        self._described = _tensor(prepared.descriptors), _tensor(leaves)
        views = object_views(map)
        self._size = _crop_size(map, views, self._extractor)
        self._finder = ObjectFinder(map, options, views)
        self._direct = Direct(map, options)

    def rounds(self, query: Query) -> Rounds:
        """Look where reference images locate the object, then where the pose projects its box.

        The whole query is used if the object is not located, if its region gives no pose, or if only
        features are given. The later look takes precedence for a point found twice.
        """
        located = LocatedObject(None, 0) if query.image is None else self._finder.find(query)
        first = self._look(query, located.region)
        pose = yield first.matches(located.references, self._pixel(located.region))
        region = pose and box_region(self._box, pose.cam_from_world, query.camera)
        if query.image is None or region == located.region:
            return
        yield self._look(query, region).added_to(first).matches(located.references, self._pixel(region))

    def near(self, query: Query, near_cam_from_world: pycolmap.Rigid3d) -> PointMatches:
        """Look where a pose projects the box; use all features if the box is out of sight."""
        region = box_region(self._box, near_cam_from_world, query.camera)
        return self._look(query, region).matches(pixel=self._pixel(region))

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """The points that were mapped from about the direction of the camera."""
        return self._direct.visible_points(cam_from_world, agreeing)

    def _pixel(self, region: Region | None) -> float:
        """Side of a pixel of the crop around a region; infinite for the whole query, which is not cropped."""
        return region.side / self._size if region else np.inf

    def _look(self, query: Query, region: Region | None) -> FoundPoints:
        """Find points in a region of a query, or in the whole query."""
        keypoints, descriptors = self._features(query, region)
        if min(len(keypoints), len(self._points)) < _FEWEST:
            return FoundPoints(np.zeros(0, np.int64), np.zeros((0, 2)))
        with torch.inference_mode():
            confidence = self._network(_tensor(descriptors), *self._described)
            pairs = mutual_matches(confidence[0], self._threshold).pairs.cpu().numpy()
        return FoundPoints(self._points[pairs[:, 1]], keypoints[pairs[:, 0]])

    def _features(self, query: Query, region: Region | None) -> "_CropFeatures":
        """Features of the crop around a region, or of the whole query."""
        if query.image is None or region is None:
            return _CropFeatures(query.keypoints, query.descriptors)
        crop = crop_region(query.image, region, self._size)
        features = self._extractor.extract(crop.image)
        keypoints = crop.to_image(features.keypoints.astype(np.float64))
        shown = np.all((keypoints >= 0) & (keypoints <= query.image.shape[1::-1]), axis=1)
        return _CropFeatures(keypoints[shown], unit_rows(features.descriptors[shown]))


class _CropFeatures(NamedTuple):
    keypoints: Points2D  # pixels of the whole image
    descriptors: Descriptors


class ObjectView(NamedTuple):
    """The object in one reference image."""

    row: int
    """Row of the image, in order of name."""

    region: Region
    """Region that shows the box."""

    points: Ids
    """Observed points in the box, ascending."""

    points2D: Points2D
    """Pixels of these points."""


class ObjectFinder:
    """Locates the object in a query by matching it with evenly spaced reference images."""

    def __init__(self, map: Map, options: MatchingOptions, views: list[ObjectView]) -> None:
        """Prepare matching.

        Args:
            map: The map.
            options: How images are matched.
            views: The object in the reference images, from `object_views`.

        Raises:
            InputError: The matcher is unknown or does not support the map's features.
        """
        self._matching = matching_with(map, options)
        self._views = [views[i] for i in evenly_spaced(len(views), LOOKED_AT)]

    def find(self, query: Query) -> LocatedObject:
        """Locate the object where the most matches with one reference image agree."""
        return locate_object(self._vote(query, view) for view in self._views)

    def _vote(self, query: Query, view: ObjectView) -> RegionVote | None:
        matches = self._matching.match([(query, view.row)], None)[0]
        kept = np.flatnonzero(np.isin(matches.points, view.points))
        pixels = view.points2D[np.searchsorted(view.points, matches.points[kept])]
        size = query.camera.width, query.camera.height
        return region_by_matches(matches.pixels(query)[kept], pixels, view.region, size)


def object_views(map: Map) -> list[ObjectView]:
    """The object in each reference image that shows its box."""
    found = []
    for row, (name, image) in enumerate(map.images.items()):
        region = box_region(map.box, image.cam_from_world(), map.camera(name))
        if region is not None:
            seen = map.observations[name]
            points, first = np.unique(seen.points, return_index=True)
            points2D = map.features[name].keypoints[seen.rows[first]].astype(np.float64)
            kept = in_box(map.box, map.points3D_in_world[points])
            found.append(ObjectView(row, region, points[kept], points2D[kept]))
    return found


def _crop_size(map: Map, views: list[ObjectView], extractor: Extractor) -> int:
    """Median size of the object in pixels of the extractor's input images."""
    longest = extractor.options.get("max_image_size", np.inf)
    names = list(map.images)
    sizes = []
    for view in views:
        camera = map.camera(names[view.row])
        sizes.append(view.region.side * min(1, longest / max(camera.width, camera.height)))
    return round(np.clip(np.median(sizes), _SMALLEST, _LARGEST)) if sizes else CROP_PX


def _check_map(map: Map) -> None:
    check_has_features(map)
    length = map.features[next(iter(map.images))].descriptors.shape[1]
    if map.info.extractor != _EXTRACTOR or length != DIMENSIONS:
        raise MapError(
            f"strategy onepose needs a map of SuperPoint features, but this map has {map.info.extractor} "
            f"features of {length} dimensions; build a map with the extractor superpoint"
        )


def _tensor(rows: Float32[np.ndarray, "n d"]) -> Tensor:
    """Descriptors in the layout and on the device of the network."""
    return torch.from_numpy(rows).to(choose_device()).T[None].contiguous()
