"""Find the points of a map in a query without keypoints, by the network of OnePose++ [1].

The network looks at a square picture of the object and at all points at once. Where in the query the object
is, reference photos tell at first, matched as wholes; then the pose, by where it puts the box.

References:
    [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation without
        CAD Models, NeurIPS 2022.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from slimsfm.arrays import Image
from slimsfm.errors import MapError
from slimsfm.features.image_matching import EncodedImage, ImageMatcher
from slimsfm.features.loftr import Loftr
from slimsfm.features.methods import DETECTOR_FREE
from slimsfm.localization.crop import (
    SIZE,
    Region,
    Sighting,
    crop_region,
    region_by_matches,
    region_of_box,
)
from slimsfm.localization.look import Finding, Look, find, spread
from slimsfm.localization.onepose_points import OnePosePoints, OnePosePointsOptions, prepare_points
from slimsfm.localization.strategy import MatchingOptions, PointMatches, Query, Rounds, Target
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.networks.devices import choose_device, inference
from slimsfm.networks.loading import load_network
from slimsfm.networks.onepose_plus import OnePosePlusMatcher, state_of
from slimsfm.weights import WEIGHTS

_POINTS = OnePosePointsOptions(max_points=15000, leaves=0)  # as by the authors
_COARSE, _FINE = 256, 128  # numbers of which a descriptor is made up
_ALL = Region(left=0.0, top=0.0, right=1.0, bottom=1.0)  # of an image, as shares of its width and height
_WEIGHTS = "loftr-onepose++"  # by which a map must have been built
_CELL_PX = 8.0  # side of a cell for which what `region_by_matches` tolerates is right


class OnePosePlus:
    """Matches pixels of a query with points by a network. O(cells x points) a look, two looks a query."""

    def __init__(self, map: Map, options: MatchingOptions = MatchingOptions()) -> None:  # noqa: ARG002
        """Describe the points and load the networks.

        Raises:
            MapError: The map was not built without a detector.
            InputError: Weights are missing.
        """
        _check_map(map)
        self._box = map.box
        self._network = load_network(OnePosePlusMatcher(), "onepose++", state_of)
        self._network.backbone.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        prepared = prepare_points(map, _POINTS)
        self._points = prepared.points
        self._described = _described(map, prepared, choose_device())
        self._finder = ObjectFinder(map, _image_matcher(map)) if map.photos else None

    def rounds(self, query: Query) -> Rounds:
        """Look where reference photos say that the object is, then where the pose puts its box.

        Where the photos tell nothing, or something that gives no pose, look at the whole image. A point that
        a later look finds is taken from where it finds it. A query without an image has no matches.
        """
        if query.image is None:
            yield PointMatches.none()
            return
        whole = _scaled(_ALL, query.camera.width, query.camera.height)
        found = self._finder.find(query.image) if self._finder else Finding(None, 0)
        first = self._look(query.image, found.region or whole)
        pose = yield first.matches(found.references)
        if pose is not None:
            region = region_of_box(self._box, pose.cam_from_world, query.camera)
        else:
            region = whole if found.region else None
        if region is not None:
            yield self._look(query.image, region).added_to(first).matches(found.references)

    def near(self, query: Query, near_cam_from_world: pycolmap.Rigid3d) -> PointMatches:
        """Look where a pose puts the box."""
        region = region_of_box(self._box, near_cam_from_world, query.camera)
        if query.image is None or region is None:
            return PointMatches.none()
        return self._look(query.image, region).matches()

    def visible_points(
        self,
        cam_from_world: pycolmap.Rigid3d,  # noqa: ARG002
        agreeing: Int64[np.ndarray, " _"] | None = None,  # noqa: ARG002
    ) -> Target:
        """Nothing: a query has no descriptors to compare those of points with."""
        return np.zeros((0, 0), np.float32), np.zeros(0, np.int64)

    def _look(self, image: Image, region: Region) -> "Look":
        """Find points in a part of an image.

        The network counts pixels from the centre of the top-left one, by half a pixel less than we do.
        """
        crop = crop_region(image, region, SIZE)
        gray = torch.from_numpy(cv2.cvtColor(crop.image, cv2.COLOR_RGB2GRAY))[None, None]
        device = self._described.points3D.device
        with torch.inference_mode(), inference(device):
            found = self._network(gray.to(device, torch.float32) / 255, *self._described)
        points2D = crop.to_image(found.points2D.double().cpu().numpy() + 0.5)
        points = self._points[found.points.cpu().numpy()]
        inside = np.all((points2D >= 0) & (points2D <= image.shape[1::-1]), axis=1)
        return Look(points[inside], points2D[inside])


class DescribedPoints(NamedTuple):
    """The points as the network takes them, where it runs."""

    points3D: Float[Tensor, "1 m 3"]
    coarse_descriptors: Float[Tensor, "1 256 m"]
    fine_descriptors: Float[Tensor, "1 128 m"]


class ObjectFinder:
    """Finds the object in a query by matching it with photos spread evenly over the reference images."""

    def __init__(self, map: Map, matcher: ImageMatcher) -> None:
        seen = {name: _region_in_photo(map, name) for name in map.images if name in map.photos}
        regions = {name: region for name, region in seen.items() if region is not None}
        names = sorted(regions)
        self._regions = {names[row]: regions[names[row]] for row in spread(len(names))}
        self._photos: Mapping[str, Image] = map.photos
        self._matcher = matcher
        self._encoded: dict[str, EncodedImage] = {}

    def find(self, image: Image) -> Finding:
        """Find the object: where most matches with a photo agree, of photos until one is sure."""
        query = self._matcher.encode(image, cells_only=True)
        return find(self._sighting(query, name) for name in self._regions)

    def _sighting(self, query: EncodedImage, name: str) -> Sighting | None:
        """Where a photo says that the object is.

        Matches are exact to half a cell; so they are judged in pixels of which a cell has 8.
        """
        reference, unit = self._reference(name), query.cell_px / _CELL_PX
        cells = self._matcher.match_cells(reference, query)
        width, height = query.image_size
        sighting = region_by_matches(
            cells.points2D_2 / unit,
            cells.points2D_1,
            _scaled(self._regions[name], *reference.image_size),
            (round(width / unit), round(height / unit)),
        )
        return sighting and replace(sighting, region=_scaled(sighting.region, unit, unit))

    def _reference(self, name: str) -> EncodedImage:
        if name not in self._encoded:
            self._encoded[name] = self._matcher.encode(self._photos[name], cells_only=True)
        return self._encoded[name]


def _check_map(map: Map) -> None:
    check_has_features(map)
    length = map.features[next(iter(map.images))].descriptors.shape[1]
    if map.info.extractor not in DETECTOR_FREE or length != _COARSE + _FINE:
        raise MapError(
            f"strategy onepose++ needs a map built without a detector, but this one has {map.info.extractor} "
            "features; build one by `slimsfm build PHOTOS -o MAP --extractor loftr`"
        )
    if map.info.extractor_options.get("weights") != _WEIGHTS:
        raise MapError(
            f"strategy onepose++ knows features of {WEIGHTS[_WEIGHTS].file} alone, and the map was built by "
            "other weights; put that file into the folder of weights and build the map again"
        )


def _described(map: Map, prepared: OnePosePoints, device: torch.device) -> DescribedPoints:
    """The points as the network takes them, about the origin: far from it, single precision is coarse."""
    points3D = map.points3D_in_world[prepared.points]
    coarse, fine = np.split(prepared.descriptors, [_COARSE], axis=1)
    arrays = points3D - points3D.mean(axis=0), coarse.T, fine.T
    return DescribedPoints(
        *(torch.from_numpy(array.astype(np.float32))[None].to(device).contiguous() for array in arrays)
    )


def _image_matcher(map: Map) -> Loftr:
    """What finds the object; weights that are missing are told of now, not when a query comes."""
    size = map.info.extractor_options.get("max_image_size", 640)
    matcher = Loftr(weights=_WEIGHTS, max_image_size=size)
    _ = matcher.network
    return matcher


def _region_in_photo(map: Map, name: str) -> Region | None:
    """Where a reference photo shows the object, as shares of its width and height."""
    camera = map.camera(name)
    region = region_of_box(map.box, map.images[name].cam_from_world(), camera)
    return region and _scaled(region, 1 / camera.width, 1 / camera.height)


def _scaled(region: Region, across: float | int, down: float | int) -> Region:
    return Region(
        left=across * region.left,
        top=down * region.top,
        right=across * region.right,
        bottom=down * region.bottom,
    )
