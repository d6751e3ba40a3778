"""Localize a query image against one map."""

from collections.abc import Callable, Iterator
from time import perf_counter

import numpy as np
import pycolmap

from slimsfm.arrays import GrayImage, Image
from slimsfm.errors import MapError
from slimsfm.features import Features, shrink_factor, unit_rows
from slimsfm.localization.cameras import (
    QueryCamera,
    camera_in_memory,
)
from slimsfm.localization.extraction import Extracted, SizedExtractor
from slimsfm.localization.matching import extract_near
from slimsfm.localization.options import LocalizationOptions, load_strategy
from slimsfm.localization.outcome import Localization, Seconds
from slimsfm.localization.round_result import RoundResult, SearchResult
from slimsfm.localization.rounds import (
    FeatureSource,
    ImageRounds,
    given_features,
    levels_of,
)
from slimsfm.localization.search import Search
from slimsfm.localization.strategy import PoseGuided, Query
from slimsfm.mapping.descriptors import descriptor_length
from slimsfm.mapping.map import Map
from slimsfm.pose import Gravity


class Localizer:
    """Localizes query images against one map. May be used by several threads at a time.

    Attributes:
        map: The map.
        options: How queries are localized.
        extractor: The extractor that the map was built with.
    """

    def __init__(self, map: Map, options: LocalizationOptions = LocalizationOptions()) -> None:
        self.map = map
        self.options = options
        self._extractor = SizedExtractor(map)
        self.extractor = self._extractor.whole
        strategy = options.strategy_for(map)
        self._strategy = load_strategy(strategy, map, options.matching)
        self._length = descriptor_length(map)
        is_exact = options.extraction == "rounds"
        self._search = Search(
            map,
            self._strategy,
            options.ransac,
            options.focal,
            is_exact=is_exact,
            matches_much=strategy == "exhaustive",
        )

    def localize(
        self,
        image: Image,
        camera: pycolmap.Camera | QueryCamera | None = None,
        gravity: Gravity | None = None,
        mask: GrayImage | None = None,
    ) -> Localization:
        """Localize one image.

        Args:
            image: RGB, upright or as stored as the map says (`read_image(path, map.info.orientation)`).
            camera: Its intrinsics. Default: the camera of the map, scaled to the image, if all reference
                images share one of the same aspect ratio. A guess suffices if the focal length is not known.
            gravity: Direction of gravity in the map and in the image, as a phone measures it.
            mask: Of the size of the image; features where it is 0 are not used.

        Raises:
            ValueError: The camera has another image size or is impossible, or none is given and the map's
                does not fit.
        """
        return self.localize_in_rounds(ImageRounds(image, mask), self.camera_of(image, camera), gravity)

    def localize_in_rounds(
        self, source: FeatureSource, camera: QueryCamera, gravity: Gravity | None = None
    ) -> Localization:
        """Localize one image like `localize`, by features that localizers of several maps may share.

        The time of an extraction counts for the localizer that is the first to need it.

        Args:
            source: Extracts features of the image.
            camera: Its intrinsics, by `camera_of`.
            gravity: As in `localize`.
        """
        before = source.seconds
        choice = "whole" if self.looks_at_images else self.options.extraction
        levels = levels_of(source, self._extractor, choice)
        found = self._search.run(levels, self._preparing(camera, source.image), camera, gravity)
        return self._localization(found, camera, source.seconds - before)

    def _preparing(self, camera: QueryCamera, image: Image | None = None) -> Callable[[Extracted], Query]:
        return lambda one: self._query(one.features, camera.camera, one.shrink_factor, image)

    def localize_near(
        self,
        image: Image,
        camera: pycolmap.Camera | QueryCamera | None,
        near_cam_from_world: pycolmap.Rigid3d,
    ) -> Localization:
        """Localize one image of approximately known pose, such as the next frame of a video.

        Extracts features only where the object's box should be, and matches them only with points that
        project near them. Several times faster than `localize`, and finds more points.

        Args:
            image: RGB, as in `localize`.
            camera: As in `localize`.
            near_cam_from_world: The approximate pose. Points must project within a twelfth of the image's
                longer side of their true position.

        Returns:
            The outcome; without a pose if the object is not near there. `localize` may find it elsewhere.

        Raises:
            ValueError: As in `localize`.
        """
        camera = self.camera_of(image, camera)
        start = perf_counter()
        found = extract_near(self.extractor, image, self.map.box, near_cam_from_world, camera.camera)
        seconds = perf_counter() - start
        query = self._query(found.features, camera.camera, found.shrink_factor, image)
        searched = self._search.near(query, camera, near_cam_from_world)
        return self._localization(searched, camera, seconds)

    @property
    def looks_at_images(self) -> bool:
        """Whether `localize_features` needs the image too, because the strategy looks at it."""
        return isinstance(self._strategy, PoseGuided) or not self.map.has_keypoints

    def localize_features(
        self,
        features: Features,
        camera: pycolmap.Camera | QueryCamera,
        gravity: Gravity | None = None,
        image: Image | None = None,
    ) -> Localization:
        """Localize an image by its features.

        Args:
            features: Features of the image by `extractor`.
            camera: Its intrinsics.
            gravity: As in `localize`.
            image: RGB, as in `localize`; needed only if `looks_at_images`.

        Raises:
            ValueError: The camera is impossible.
        """
        camera = _given(camera)
        levels = given_features(features, self._shrink_factor(camera))
        found = self._search.run(levels, self._preparing(camera, image), camera, gravity)
        return self._localization(found, camera, 0.0)

    def search(self, features: Features, camera: pycolmap.Camera | QueryCamera) -> SearchResult:
        """Localize an image by its features, with the evidence, and without a limit on the confidence."""
        camera = _given(camera)
        levels = given_features(features, self._shrink_factor(camera))
        return self._search.run(levels, self._preparing(camera), camera)

    def rounds(self, features: Features, camera: pycolmap.Camera | QueryCamera) -> Iterator[RoundResult]:
        """Run all rounds of the strategy, without stopping early."""
        camera = _given(camera)
        query = self._query(features, camera.camera, self._shrink_factor(camera), None)
        return self._search.rounds(query, camera)

    def _shrink_factor(self, camera: QueryCamera) -> float:
        return shrink_factor(self.extractor.options, camera.camera.width, camera.camera.height)

    def _localization(self, found: SearchResult, camera: QueryCamera, extract_seconds: float) -> Localization:
        matches, pose, evidence = found.best.matches, found.best.pose, found.best.evidence
        reason = found.best.doubt(self.options.min_confidence)
        if reason:
            pose = evidence = None
        return Localization(
            pose=pose,
            reason=reason,
            camera=found.best.camera,
            camera_source=camera.source,
            camera_notes=camera.notes,
            points2D=matches.pixels(found.best.query),
            points3D_in_world=self.map.points3D_in_world[matches.points],
            references=found.references,
            predicted_corner_error=evidence and evidence.predicted_error,
            seconds=Seconds(extract=extract_seconds, match=found.match_seconds, pose=found.pose_seconds),
            orientation=self.map.info.orientation,
        )

    def _query(
        self, features: Features, camera: pycolmap.Camera, factor: float, image: Image | None
    ) -> Query:
        length = features.descriptors.shape[1]
        if len(features) and self._length not in (None, length):
            raise MapError(
                f"the map's descriptors have {self._length} values, those of its extractor "
                f"{self.extractor.name!r} {length}; make the map again with the right extractor"
            )
        order = np.argsort(-features.scores, kind="stable")
        if np.any(np.diff(order) < 0):
            features = features[order]
        return Query(
            keypoints=features.keypoints.astype(np.float64),
            descriptors=unit_rows(features.descriptors),
            features=features,
            camera=camera,
            image=image,
            shrink_factor=factor,
        )

    def camera_of(self, image: Image, given: pycolmap.Camera | QueryCamera | None = None) -> QueryCamera:
        """Intrinsics of an image, see `camera_in_memory`.

        Args:
            image: RGB, as in `localize`.
            given: Intrinsics to use.

        Raises:
            ValueError: The image is not RGB of eight bits, the given camera has another image size, or the
                focal length must be known but none is given and the map's does not fit.
        """
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise ValueError(
                f"image must be RGB, uint8 of shape (height, width, 3), got {image.dtype} of {image.shape}"
            )
        height, width = image.shape[:2]
        if isinstance(given, QueryCamera):
            camera_in_memory(self.map, width, height, given.camera)  # checks the size
            return given
        found = camera_in_memory(self.map, width, height, given)
        if found.source == "unknown" and self.options.focal == "known":
            raise ValueError(
                f"camera must be given: the map has no single camera for an image of {width}x{height} pixels"
            )
        return found


def _given(camera: pycolmap.Camera | QueryCamera) -> QueryCamera:
    return camera if isinstance(camera, QueryCamera) else QueryCamera(camera=camera, source="given")
