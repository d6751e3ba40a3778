"""From a query image to its pose."""

from dataclasses import dataclass
from importlib import import_module
from threading import local
from time import perf_counter

import numpy as np
import pycolmap
from jaxtyping import Shaped

from slimsfm.arrays import Descriptors, Image
from slimsfm.features import Features, load_extractor, unit_rows
from slimsfm.localization.cameras import scaled_camera
from slimsfm.localization.strategy import Strategy
from slimsfm.mapping.map import Map
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose

# Paths, not classes: naming a strategy must not import what it needs.
STRATEGIES = {
    "direct": "slimsfm.localization.direct:Direct",
    "exhaustive": "slimsfm.localization.exhaustive:Exhaustive",
}


@dataclass(frozen=True, kw_only=True)
class LocalizationOptions:
    """How queries are localized."""

    strategy: str = "auto"
    """Match against each reference image (exhaustive) or against the points (direct); auto: direct where the
    map has points chosen for it."""

    ransac: RansacOptions = RansacOptions()
    """The pose search."""

    def __post_init__(self) -> None:
        if self.strategy not in ("auto", *STRATEGIES):
            raise ValueError(
                f"strategy must be auto or one of {', '.join(sorted(STRATEGIES))}, got {self.strategy!r}"
            )

    def strategy_for(self, map: Map) -> str:
        """The strategy to use with a map."""
        if self.strategy != "auto":
            return self.strategy
        return "exhaustive" if map.point_descriptors is None else "direct"


@dataclass(frozen=True, kw_only=True)
class Seconds:
    """Wall time of each stage."""

    extract: float
    """Features of the query."""

    match: float
    """Query against map."""

    pose: float
    """Pose from matches."""

    @property
    def total(self) -> float:
        """All stages."""
        return self.extract + self.match + self.pose


@dataclass(frozen=True, kw_only=True, eq=False)
class Localization:
    """What became of one query."""

    pose: PoseEstimate | None
    """Where the camera stood, or None: the query could not be localized."""

    num_matches: int
    """2D-3D matches that the pose was sought in."""

    seconds: Seconds
    """Time it took."""


class Localizer:
    """Localizes query images against one map."""

    def __init__(self, map: Map, options: LocalizationOptions = LocalizationOptions()) -> None:
        self._map = map
        self._options = options
        self._extractor = load_extractor(map.info.extractor, map.info.extractor_options)
        self._memory = local()
        module, attribute = STRATEGIES[options.strategy_for(map)].split(":")
        self._strategy: Strategy = getattr(import_module(module), attribute)(map)

    def localize(self, image: Image, camera: pycolmap.Camera | None = None) -> Localization:
        """Localize one image.

        Args:
            image: Upright RGB.
            camera: Its intrinsics; those of the map where all reference images share a camera and the sizes
                agree up to a common scale.

        Raises:
            ValueError: No camera is given and the map's cannot stand in, or it is of another size.
        """
        camera = camera or self._map_camera(image)
        if (camera.width, camera.height) != image.shape[1::-1]:
            raise ValueError(
                f"camera must be of the image's size {image.shape[1]}x{image.shape[0]}, "
                f"got {camera.width}x{camera.height}"
            )
        start = perf_counter()
        features = self._extractor.extract(image)
        return self._localize(features, camera, perf_counter() - start)

    def localize_features(self, features: Features, camera: pycolmap.Camera) -> Localization:
        """Localize an image by features that its map's extractor gave."""
        return self._localize(features, camera, 0.0)

    def _localize(self, features: Features, camera: pycolmap.Camera, extract_seconds: float) -> Localization:
        start = perf_counter()
        matches = self._strategy.match(self._unit_rows(features.descriptors))
        matched = perf_counter()
        pose = estimate_pose(
            features.keypoints[matches.keypoints].astype(np.float64),
            self._map.points3D_in_world[matches.points],
            camera,
            self._options.ransac,
        )
        seconds = Seconds(extract=extract_seconds, match=matched - start, pose=perf_counter() - matched)
        return Localization(pose=pose, num_matches=len(matches), seconds=seconds)

    def _unit_rows(self, descriptors: Shaped[np.ndarray, "n d"]) -> Descriptors:
        """Rows of unit length, in memory that each thread uses again: fresh pages are dear."""
        memory = getattr(self._memory, "rows", None)
        count, dimensions = descriptors.shape
        if memory is None or len(memory) < count or memory.shape[1] != dimensions:
            memory = self._memory.rows = np.empty((count, dimensions), np.float32)
        return unit_rows(descriptors, out=memory[:count])

    def _map_camera(self, image: Image) -> pycolmap.Camera:
        height, width = image.shape[:2]
        shared = self._map.shared_camera
        camera = shared and scaled_camera(shared, width, height)
        if camera is None:
            raise ValueError(
                f"camera must be given: the map has no one camera for an image of {width}x{height} pixels"
            )
        return camera
