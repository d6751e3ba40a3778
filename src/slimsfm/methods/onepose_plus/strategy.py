"""The strategy `onepose++`: finds the points of a map in a query without keypoints, by a network [1].

The network takes a square crop of the object and all points. Reference photos, matched as a whole, locate
the object in the query first; then the pose does, by projecting its box.

References:
    [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation without
        CAD Models, NeurIPS 2022.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from slimsfm.arrays import Image, evenly_spaced
from slimsfm.errors import MapError
from slimsfm.localization.strategy import MatchingOptions, PointMatches, Query, Rounds, Target
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.methods.loftr.cells import EncodedImage, ImageMatcher
from slimsfm.methods.loftr.matcher import Loftr
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
from slimsfm.methods.onepose.points import OnePosePoints, OnePosePointsOptions, prepare_points
from slimsfm.methods.onepose_plus.network import CoarseToFine, OnePosePlusMatcher
from slimsfm.networks.loading import choose_device, inference, load_network, matcher_state
from slimsfm.weight_files import WEIGHTS

_POINTS = OnePosePointsOptions(max_points=15000, leaves=0)  # as in the authors' code
_COARSE, _FINE = 256, 128  # dimensions of the two parts of a descriptor
_WHOLE = Region(left=0.0, top=0.0, right=1.0, bottom=1.0)  # relative to the image's width and height
_WEIGHTS = "loftr-onepose++"  # the map must have been built with these
_CELL_PX = 8.0  # side of a cell for which the error limit of `region_by_matches` is right

FindPoints = Callable[..., CoarseToFine]
"""Takes a gray crop (1, 1, side, side) from 0 to 1 and the fields of `DescribedPoints`."""


class OnePosePlusStrategy:
    """Matches pixels of a query with points by a network. O(cells x points) per look, two looks per query."""

    def __init__(
        self,
        map: Map,
        options: MatchingOptions = MatchingOptions(),  # noqa: ARG002
        *,
        network: FindPoints | None = None,
        crop_px: int = CROP_PX,
    ) -> None:
        """Describe the points and load the networks.

        Args:
            map: A map built without a detector.
            options: Not used.
            network: Finds points in a crop; by default OnePose++'s network with its trained weights.
            crop_px: Side of the crops in pixels, a multiple of 8.

        Raises:
            MapError: The map was not built without a detector, or with other weights.
            InputError: Weights are missing.
        """
        _check_map(map)
        self._box, self._crop_px = map.box, crop_px
        self._network = network or _load_network()
        prepared = prepare_points(map, _POINTS)
        self._points = prepared.points
        self._described = _described(map, prepared, choose_device())
        self._finder = PhotoObjectFinder(map, _image_matcher(map)) if map.photos else None

    def rounds(self, query: Query) -> Rounds:
        """Look where reference photos locate the object, then where the pose projects its box.

        The whole image is used if the object is not located or its region gives no pose. The later look takes
        precedence for a point found twice. A query without an image has no matches.
        """
        if query.image is None:
            yield PointMatches.none()
            return
        whole = _WHOLE.scaled(query.camera.width, query.camera.height)
        located = self._finder.find(query.image) if self._finder else LocatedObject(None, 0)
        first = self._look(query.image, located.region or whole)
        pose = yield first.matches(located.references, (located.region or whole).side / self._crop_px)
        if pose is not None:
            region = box_region(self._box, pose.cam_from_world, query.camera)
        else:
            region = whole if located.region else None
        if region is not None:
            second = self._look(query.image, region).added_to(first)
            yield second.matches(located.references, region.side / self._crop_px)

    def near(self, query: Query, near_cam_from_world: pycolmap.Rigid3d) -> PointMatches:
        """Look where a pose projects the box."""
        region = box_region(self._box, near_cam_from_world, query.camera)
        if query.image is None or region is None:
            return PointMatches.none()
        return self._look(query.image, region).matches(pixel=region.side / self._crop_px)

    def visible_points(
        self,
        cam_from_world: pycolmap.Rigid3d,  # noqa: ARG002
        agreeing: Int64[np.ndarray, " _"] | None = None,  # noqa: ARG002
    ) -> Target:
        """No points, because a query has no descriptors to compare with."""
        return np.zeros((0, 0), np.float32), np.zeros(0, np.int64)

    def _look(self, image: Image, region: Region) -> FoundPoints:
        """Find points in a region of an image.

        The network puts the center of the top-left pixel at (0, 0), half a pixel less than we do.
        """
        crop = crop_region(image, region, self._crop_px)
        gray = torch.from_numpy(cv2.cvtColor(crop.image, cv2.COLOR_RGB2GRAY))[None, None]
        device = self._described.points3D.device
        with torch.inference_mode(), inference(device):
            found = self._network(gray.to(device, torch.float32) / 255, *self._described)
        points2D = crop.to_image(found.points2D.double().cpu().numpy() + 0.5)
        points = self._points[found.points.cpu().numpy()]
        inside = np.all((points2D >= 0) & (points2D <= image.shape[1::-1]), axis=1)
        return FoundPoints(points[inside], points2D[inside])


class DescribedPoints(NamedTuple):
    """The points as the network takes them, on its device."""

    points3D: Float[Tensor, "1 m 3"]
    coarse_descriptors: Float[Tensor, "1 256 m"]
    fine_descriptors: Float[Tensor, "1 128 m"]


class PhotoObjectFinder:
    """Locates the object in a query by matching it with evenly spaced reference photos."""

    def __init__(self, map: Map, matcher: ImageMatcher) -> None:
        seen = {name: _region_in_photo(map, name) for name in map.images if name in map.photos}
        regions = {name: region for name, region in seen.items() if region is not None}
        names = sorted(regions)
        self._regions = {names[row]: regions[names[row]] for row in evenly_spaced(len(names), LOOKED_AT)}
        self._photos: Mapping[str, Image] = map.photos
        self._matcher = matcher
        self._encoded: dict[str, EncodedImage] = {}

    def find(self, image: Image) -> LocatedObject:
        """Locate the object where the most matches with one photo agree."""
        query = self._matcher.encode(image, cells_only=True)
        return locate_object(self._vote(query, name) for name in self._regions)

    def _vote(self, query: EncodedImage, name: str) -> RegionVote | None:
        """The region of the object according to one photo.

        Matches are exact to half a cell, so errors are measured in pixels of which a cell has 8.
        """
        reference, unit = self._reference(name), query.cell_px / _CELL_PX
        cells = self._matcher.match_cells(reference, query)
        width, height = query.image_size
        vote = region_by_matches(
            cells.points2D_2 / unit,
            cells.points2D_1,
            self._regions[name].scaled(*reference.image_size),
            (round(width / unit), round(height / unit)),
        )
        return vote and replace(vote, region=vote.region.scaled(unit, unit))

    def _reference(self, name: str) -> EncodedImage:
        if name not in self._encoded:
            self._encoded[name] = self._matcher.encode(self._photos[name], cells_only=True)
        return self._encoded[name]


def _load_network() -> OnePosePlusMatcher:
    network = load_network(OnePosePlusMatcher(), "onepose++", matcher_state)
    network.backbone.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    return network


def _check_map(map: Map) -> None:
    check_has_features(map)
    length = map.features[next(iter(map.images))].descriptors.shape[1]
    if map.has_keypoints or length != _COARSE + _FINE:
        raise MapError(
            f"strategy onepose++ needs a map built without a detector, but this map has {map.info.extractor} "
            "features; build a map with the extractor loftr"
        )
    if map.info.extractor_options.get("weights") != _WEIGHTS:
        raise MapError(
            f"strategy onepose++ needs a map built with the weights {WEIGHTS[_WEIGHTS].file}, but this map "
            "was built with others; put that file into the weights folder and build the map again"
        )


def _described(map: Map, prepared: OnePosePoints, device: torch.device) -> DescribedPoints:
    """The points relative to their mean: far from the origin, single precision is coarse."""
    points3D = map.points3D_in_world[prepared.points]
    coarse, fine = np.split(prepared.descriptors, [_COARSE], axis=1)
    arrays = points3D - points3D.mean(axis=0), coarse.T, fine.T
    return DescribedPoints(
        *(torch.from_numpy(array.astype(np.float32))[None].to(device).contiguous() for array in arrays)
    )


def _image_matcher(map: Map) -> Loftr:
    """The matcher that locates the object; loads its network now, so that missing weights raise early."""
    size = map.info.extractor_options.get("max_image_size", 640)
    matcher = Loftr(weights=_WEIGHTS, max_image_size=size)
    _ = matcher.network
    return matcher


def _region_in_photo(map: Map, name: str) -> Region | None:
    """The region of the object in a reference photo, relative to its width and height."""
    camera = map.camera(name)
    region = box_region(map.box, map.images[name].cam_from_world(), camera)
    return region and region.scaled(1 / camera.width, 1 / camera.height)
