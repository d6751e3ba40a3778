"""Match the keypoints of a query with all points of a map at once, by the network of OnePose [1].

The network was trained on square pictures that the object fills, those of the map as those of queries. Where
in the query it is, reference images tell at first, matched with it by nearest descriptors or as it is asked
for; then the pose, by where it puts the box. This part is drawn as large as the references show the object,
for descriptors of SuperPoint fit each other at equal scale.

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

from slimsfm.arrays import Descriptors, Ids, Points2D
from slimsfm.errors import MapError
from slimsfm.features import Extractor, load_extractor, unit_rows
from slimsfm.localization.crop import SIZE, Region, Sighting, crop_region, region_by_matches, region_of_box
from slimsfm.localization.direct import Direct
from slimsfm.localization.look import Finding, Look, find, spread
from slimsfm.localization.matching import matching_with
from slimsfm.localization.onepose_points import inside, prepare_points
from slimsfm.localization.strategy import MatchingOptions, PointMatches, Query, Rounds, Target
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.networks.devices import choose_device
from slimsfm.networks.loading import load_network
from slimsfm.networks.onepose import DIMENSIONS, GraphAttentionMatcher, mutual_matches, state_of

_EXTRACTOR = "superpoint"
_FEWEST = 2  # keypoints and points: the network normalizes over them
_SMALLEST, _LARGEST = 64, 1024  # pixels along a side of a part that is looked at


class OnePose:
    """Matches by attention. O(keypoints x points) a look, two looks a query."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:
        """Describe the points and load the networks.

        Raises:
            MapError: The map has no SuperPoint features.
            InputError: Weights are missing, or the matcher cannot match features of the map's kind.
        """
        _check_map(map)
        self._box = map.box
        self._network = load_network(GraphAttentionMatcher(), "onepose", state_of)
        self._extractor = load_extractor(map.info.extractor, map.info.extractor_options)
        prepared = prepare_points(map)
        self._points = prepared.points
        leaves = prepared.leaves.reshape(-1, DIMENSIONS)
        self._described = _tensor(prepared.descriptors), _tensor(leaves)
        sights = _sights(map)
        self._size = _picture_size(map, sights, self._extractor)
        self._finder = ObjectFinder(map, options, sights)
        self._direct = Direct(map, options)

    def rounds(self, query: Query) -> Rounds:
        """Look where reference images say that the object is, then where the pose puts its box.

        Where they tell nothing, or something that gives no pose, or where there is no image but just its
        features, look at the whole. A point that a later look finds is taken from where it finds it.
        """
        found = Finding(None, 0) if query.image is None else self._finder.find(query)
        first = self._look(query, found.region)
        pose = yield first.matches(found.references)
        region = pose and region_of_box(self._box, pose.cam_from_world, query.camera)
        if query.image is None or region == found.region:
            return
        yield self._look(query, region).added_to(first).matches(found.references)

    def near(self, query: Query, near_cam_from_world: pycolmap.Rigid3d) -> PointMatches:
        """Look where a pose puts the box; at all features where it puts it out of sight."""
        return self._look(query, region_of_box(self._box, near_cam_from_world, query.camera)).matches()

    def visible_points(
        self, cam_from_world: pycolmap.Rigid3d, agreeing: Int64[np.ndarray, " _"] | None = None
    ) -> Target:
        """The points that were seen from about where the camera stands."""
        return self._direct.visible_points(cam_from_world, agreeing)

    def _look(self, query: Query, region: Region | None) -> Look:
        """Find points in a part of a query, or in the whole."""
        keypoints, descriptors = self._seen(query, region)
        if min(len(keypoints), len(self._points)) < _FEWEST:
            return Look(np.zeros(0, np.int64), np.zeros((0, 2)))
        with torch.inference_mode():
            confidence = self._network(_tensor(descriptors), *self._described)
            pairs = mutual_matches(confidence[0]).pairs.cpu().numpy()
        return Look(self._points[pairs[:, 1]], keypoints[pairs[:, 0]])

    def _seen(self, query: Query, region: Region | None) -> "_Seen":
        """Keypoints in a part of a query, seen by themselves, or those of the whole."""
        if query.image is None or region is None:
            return _Seen(query.keypoints, query.descriptors)
        crop = crop_region(query.image, region, self._size)
        features = self._extractor.extract(crop.image)
        keypoints = crop.to_image(features.keypoints.astype(np.float64))
        shown = np.all((keypoints >= 0) & (keypoints <= query.image.shape[1::-1]), axis=1)
        return _Seen(keypoints[shown], unit_rows(features.descriptors[shown]))


class _Seen(NamedTuple):
    keypoints: Points2D
    descriptors: Descriptors


class Sight(NamedTuple):
    """The object as a reference image shows it."""

    row: int
    """The image, in order of name."""

    region: Region
    """The part of it that shows the box."""

    points: Ids
    """Points in the box that it sees, ascending."""

    points2D: Points2D
    """Their pixels."""


class ObjectFinder:
    """Finds the object in a query by matching it with images spread evenly over the references."""

    def __init__(self, map: Map, options: MatchingOptions, sights: list[Sight]) -> None:
        """Prepare matching.

        Args:
            map: The map.
            options: What matches.
            sights: Of the images that show the object.

        Raises:
            InputError: The matcher is unknown, or cannot match features of the map's kind.
        """
        self._matching = matching_with(map, options)
        self._sights = [sights[i] for i in spread(len(sights))]

    def find(self, query: Query) -> Finding:
        """Find the object: where most of its points that are matched with an image agree."""
        return find(self._sighting(query, sight) for sight in self._sights)

    def _sighting(self, query: Query, sight: Sight) -> Sighting | None:
        matches = self._matching.match(query, sight.row, None)
        kept = np.flatnonzero(np.isin(matches.points, sight.points))
        pixels = sight.points2D[np.searchsorted(sight.points, matches.points[kept])]
        size = query.camera.width, query.camera.height
        return region_by_matches(matches.pixels(query)[kept], pixels, sight.region, size)


def _sights(map: Map) -> list[Sight]:
    """The object in all reference images that show it."""
    found = []
    for row, (name, image) in enumerate(map.images.items()):
        region = region_of_box(map.box, image.cam_from_world(), map.camera(name))
        if region is not None:
            seen = map.observations[name]
            points, first = np.unique(seen.points, return_index=True)
            points2D = map.features[name].keypoints[seen.rows[first]].astype(np.float64)
            kept = inside(map.box, map.points3D_in_world[points])
            found.append(Sight(row, region, points[kept], points2D[kept]))
    return found


def _picture_size(map: Map, sights: list[Sight], extractor: Extractor) -> int:
    """How many pixels of what the extractor saw of the references the object is large, by the median."""
    longest = extractor.options.get("max_image_size", np.inf)
    names = list(map.images)
    sizes = []
    for sight in sights:
        camera = map.camera(names[sight.row])
        sizes.append(sight.region.side * min(1, longest / max(camera.width, camera.height)))
    return round(np.clip(np.median(sizes), _SMALLEST, _LARGEST)) if sizes else SIZE


def _check_map(map: Map) -> None:
    check_has_features(map)
    length = map.features[next(iter(map.images))].descriptors.shape[1]
    if map.info.extractor != _EXTRACTOR or length != DIMENSIONS:
        raise MapError(
            f"strategy onepose needs a map of SuperPoint features, but this one has {map.info.extractor} "
            f"features of {length} numbers; build one by `slimsfm build PHOTOS -o MAP --extractor superpoint`"
        )


def _tensor(rows: Float32[np.ndarray, "n d"]) -> Tensor:
    """Descriptors as the network takes them, where it runs."""
    return torch.from_numpy(rows).to(choose_device()).T[None].contiguous()
