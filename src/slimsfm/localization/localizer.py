"""From a query image to its pose."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import pycolmap

from slimsfm.arrays import Image, Points2D, Points3D
from slimsfm.features import Features, load_extractor, unit_rows
from slimsfm.features.registry import importing, load_object, plugins
from slimsfm.gravity import Gravity
from slimsfm.localization.cameras import FocalLength, guess_camera, scaled_camera
from slimsfm.localization.guided_matching import extract_near
from slimsfm.localization.search import RoundResult, Search, SearchResult
from slimsfm.localization.strategy import MatchingOptions, PoseGuided, Query, Strategy
from slimsfm.mapping.map import Map
from slimsfm.pose import PoseEstimate, RansacOptions

# Paths, not classes: naming a strategy must not import what it needs.
STRATEGIES = {
    "direct": "slimsfm.localization.direct:Direct",
    "exhaustive": "slimsfm.localization.exhaustive:Exhaustive",
    "onepose": "slimsfm.methods.onepose.strategy:OnePoseStrategy",
    "onepose++": "slimsfm.methods.onepose_plus.strategy:OnePosePlusStrategy",
    "progressive": "slimsfm.localization.progressive:Progressive",
    "retrieval": "slimsfm.localization.retrieval:Retrieval",
}


@dataclass(frozen=True, kw_only=True)
class LocalizationOptions:
    """How queries are localized."""

    strategy: str = "auto"
    """Match against each reference image (exhaustive), those that look like the query (retrieval), one after
    the other until the pose is sure (progressive), or against the points, by their descriptors (direct) or by
    a network (onepose, onepose++); auto: direct where the map has points chosen for it, exhaustive where it
    was built without a detector, else progressive."""

    matching: MatchingOptions = MatchingOptions()
    """How strategies match."""

    ransac: RansacOptions = RansacOptions()
    """The pose search."""

    focal: FocalLength = "known"
    """Whether the queries' focal length is known, known to 30 % (approximate), or unknown: then it is
    estimated together with the pose."""

    min_confidence: float = 0.5
    """A pose less sure than this is not given out: the query counts as not localized."""

    def __post_init__(self) -> None:
        known = sorted({**STRATEGIES, **plugins("strategy")})
        if self.strategy not in ("auto", *known):
            raise ValueError(f"strategy must be auto or one of {', '.join(known)}, got {self.strategy!r}")
        if not 0 <= self.min_confidence <= 1:
            raise ValueError(f"min_confidence must be between 0 and 1, got {self.min_confidence}")

    def strategy_for(self, map: Map) -> str:
        """The strategy to use with a map."""
        if self.strategy != "auto":
            return self.strategy
        if not map.has_keypoints:
            return "exhaustive"
        return "progressive" if map.point_descriptors is None else "direct"


def load_strategy(name: str, map: Map, options: MatchingOptions = MatchingOptions()) -> Strategy:
    """Make the strategy of this name for a map.

    Raises:
        InputError: What it needs is missing.
        MapError: It cannot work with such a map.
    """
    with importing(f"strategy {name!r}"):
        return _strategy_class(name)(map, options)


def supports(strategy: str, map: Map) -> bool:
    """Whether a map has what the strategy of this name requires.

    Raises:
        InputError: A package that the strategy needs is missing.
    """
    if strategy == "auto":
        return True
    with importing(f"strategy {strategy!r}"):
        requires = getattr(_strategy_class(strategy), "requires", "features")
    return map.has_keypoints if requires == "points" else not map.is_for_direct_matching


def _strategy_class(name: str) -> Callable[[Map, MatchingOptions], Strategy]:
    return load_object({**plugins("strategy"), **STRATEGIES}[name])


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

    camera: pycolmap.Camera
    """The intrinsics; with the focal length that was found where it was not known."""

    points2D: Points2D
    """Pixels of the 2D-3D matches that the pose was sought in."""

    points3D_in_world: Points3D
    """For each of them the point of the map."""

    references: int
    """Reference images that the query was matched with."""

    predicted_corner_error: float | None = None
    """Relative corner error to expect of the pose, should its inliers be right; None where there is none."""

    seconds: Seconds
    """Time it took."""

    @property
    def num_matches(self) -> int:
        """How many 2D-3D matches there were."""
        return len(self.points2D)


class Localizer:
    """Localizes query images against one map."""

    def __init__(self, map: Map, options: LocalizationOptions = LocalizationOptions()) -> None:
        self.map = map
        self._options = options
        self.extractor = load_extractor(map.info.extractor, map.info.extractor_options)
        self._strategy = load_strategy(options.strategy_for(map), map, options.matching)
        self._search = Search(map, self._strategy, options.ransac, options.focal)

    def localize(
        self, image: Image, camera: pycolmap.Camera | None = None, gravity: Gravity | None = None
    ) -> Localization:
        """Localize one image.

        Args:
            image: Upright RGB.
            camera: Its intrinsics; those of the map where all reference images share a camera and the sizes
                agree up to a common scale. Where the focal length is unknown, a guess will do.
            gravity: Where down is in the map and in the image, as a phone tells; used where the focal length
                is known.

        Raises:
            ValueError: No camera is given and the map's cannot stand in, or it is of another size.
        """
        camera = self.camera_of(image, camera)
        start = perf_counter()
        features = self.extractor.extract(image)
        seconds, query = perf_counter() - start, self._query(features, camera, image)
        return self._localization(query, self._search.run(query, camera, gravity), seconds)

    def localize_near(
        self, image: Image, camera: pycolmap.Camera | None, near_cam_from_world: pycolmap.Rigid3d
    ) -> Localization:
        """Localize one image whose pose is about known, as that of the last frame of a video.

        Features are sought just where the object's box should be, and matched just with points that project
        near them: several times faster than `localize`, and more points are found.

        Args:
            image: Upright RGB.
            camera: As of `localize`.
            near_cam_from_world: A pose under which points project within a twelfth of the image's longer side
                of where they are.

        Returns:
            No pose where the object is not about there; `localize` may find it elsewhere.

        Raises:
            ValueError: As of `localize`.
        """
        camera = self.camera_of(image, camera)
        start = perf_counter()
        features = extract_near(self.extractor, image, self.map.box, near_cam_from_world, camera)
        seconds, query = perf_counter() - start, self._query(features, camera, image)
        return self._localization(query, self._search.near(query, camera, near_cam_from_world), seconds)

    @property
    def looks_at_images(self) -> bool:
        """Whether features alone are not enough: the strategy looks at queries itself."""
        return isinstance(self._strategy, PoseGuided) or not self.map.has_keypoints

    def localize_features(
        self,
        features: Features,
        camera: pycolmap.Camera,
        gravity: Gravity | None = None,
        image: Image | None = None,
    ) -> Localization:
        """Localize an image by features that its map's extractor gave, and by itself where that is needed."""
        query = self._query(features, camera, image)
        return self._localization(query, self._search.run(query, camera, gravity), 0.0)

    def attempts(self, features: Features, camera: pycolmap.Camera) -> Iterator[RoundResult]:
        """Everything that the strategy would try, round by round, without an early stop."""
        return self._search.attempts(self._query(features, camera), camera)

    def _localization(self, query: Query, found: SearchResult, extract_seconds: float) -> Localization:
        matches, pose, evidence = found.best.matches, found.best.pose, found.best.evidence
        if found.best.confidence < self._options.min_confidence:
            pose = evidence = None
        return Localization(
            pose=pose,
            camera=found.best.camera,
            points2D=matches.pixels(query),
            points3D_in_world=self.map.points3D_in_world[matches.points],
            references=found.references,
            predicted_corner_error=evidence and evidence.predicted_error,
            seconds=Seconds(extract=extract_seconds, match=found.match_seconds, pose=found.pose_seconds),
        )

    def _query(self, features: Features, camera: pycolmap.Camera, image: Image | None = None) -> Query:
        order = np.argsort(-features.scores, kind="stable")
        if np.any(np.diff(order) < 0):
            features = features[order]
        return Query(
            keypoints=features.keypoints.astype(np.float64),
            descriptors=unit_rows(features.descriptors),
            features=features,
            camera=camera,
            image=image,
        )

    def camera_of(self, image: Image, given: pycolmap.Camera | None = None) -> pycolmap.Camera:
        """The intrinsics of an image: those given, else those of the map, scaled.

        Raises:
            ValueError: There are none, or they are of an image of another size.
        """
        height, width = image.shape[:2]
        shared = self.map.shared_camera
        camera = given or (shared and scaled_camera(shared, width, height))
        if camera is None and self._options.focal != "known":
            camera = guess_camera(width, height)
        if camera is None:
            raise ValueError(
                f"camera must be given: the map has no one camera for an image of {width}x{height} pixels"
            )
        if (camera.width, camera.height) != (width, height):
            raise ValueError(
                f"camera must be of the image's size {width}x{height}, got {camera.width}x{camera.height}"
            )
        return camera
