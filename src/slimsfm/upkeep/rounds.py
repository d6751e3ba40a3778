"""Rounds of adding photos to a map: localize, add those that are sure, and try the others again."""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field

import numpy as np
import pycolmap

from slimsfm.arrays import IndexPairs
from slimsfm.execution import map_on_threads, num_cores
from slimsfm.features import unit_rows
from slimsfm.lenses import camera_fault
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.cameras import QueryCamera
from slimsfm.localization.round_result import SearchResult
from slimsfm.localization.shared_cameras import share_cameras
from slimsfm.localization.strategies import ImageRanking
from slimsfm.mapping.blocks import Workers
from slimsfm.mapping.cameras import camera_key
from slimsfm.mapping.map import Map
from slimsfm.mapping.quality import MIN_COMMON_POINTS
from slimsfm.mapping.support import MIN_AGREEING, agreement
from slimsfm.progress import ProgressBar
from slimsfm.upkeep.extension import NewImage, extend_map
from slimsfm.upkeep.neighbors import LocalizedImage, likely_neighbors
from slimsfm.upkeep.new_matches import match_new
from slimsfm.upkeep.new_photos import NewPhotos

_SIMILAR = 10  # images of the map, by which a photo is tried again if they are new
_TRUSTED = ("given", "map")  # sources of intrinsics that are not refined


@dataclass(frozen=True, kw_only=True)
class AddOptions:
    """How photos are added to a map."""

    min_confidence: float = 0.9
    """Confidence that a pose needs, from 0 to 1. Photos below it are tried again when similar ones enter."""

    matcher: str = "nearest"
    """Matcher of the features, as in `build`: nearest, lightglue or superglue."""

    refine: bool = False
    """Adjust all poses, cameras and points in the end: old images move, and how far is said."""

    strict: bool = False
    """Stop at the first photo that cannot be read, instead of skipping it."""

    seed: int = 0
    """Seed of every random choice."""

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence <= 1:
            raise ValueError(f"min_confidence must be between 0 and 1, got {self.min_confidence}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


@dataclass(kw_only=True, eq=False)
class Adding:
    """The state of adding photos, round by round."""

    map: Map
    photos: NewPhotos
    options: AddOptions
    workers: Workers
    progress: ProgressBar
    added: set[str] = field(default_factory=set)
    reasons: dict[str, str] = field(default_factory=dict)
    rounds: int = 0
    _cameras: dict[tuple, int] = field(default_factory=dict)  # ids of new cameras by their first intrinsics

    def run(self) -> None:
        """Add what is sure, until nothing is."""
        left = tried = list(self.photos.names)
        while tried:
            self.rounds += 1
            found = self._localize(tried)
            sure = {name: one for name, one in found.items() if name not in self.reasons}
            entered = self._enter(sure) if sure else set()
            if not entered:
                return
            self.added |= entered
            left = [name for name in left if name not in entered]
            tried = self._similar_to(entered, left) if left else []

    def _similar_to(self, entered: set[str], left: list[str]) -> list[str]:
        """The photos that may match those that entered, which are among the images most similar to them."""
        ranking, features = ImageRanking(self.map), self.photos.extracted.features
        new = [place for place, name in enumerate(self.map.images) if name in entered]
        found = []
        for name in left:
            strongest = np.argsort(-features[name].scores, kind="stable")
            similarities = ranking.similarities(unit_rows(features[name].descriptors[strongest]))
            if np.isin(np.argsort(-similarities, kind="stable")[:_SIMILAR], new).any():
                found.append(name)
        return found

    def _localize(self, names: list[str]) -> dict[str, SearchResult]:
        """Localize photos in the map so far; `reasons` holds why some are not sure afterwards."""
        localizer = Localizer(self.map, LocalizationOptions(min_confidence=0.0))
        features = self.photos.extracted.features
        cameras = self._shared_cameras(localizer, names)
        outcomes = map_on_threads(
            lambda name: localizer.search(features[name], cameras[name]), names, num_cores()
        )
        label = "localize new photos" if self.rounds == 1 else f"localize new photos again ({self.rounds})"
        found = {name: next(outcomes) for name in self.progress(names, label)}
        believed = sum(self.photos.cameras[name].source in _TRUSTED for name in self.added)
        lone = _lone_cameras(found, cameras, believed)
        for name, one in found.items():
            reason = one.best.doubt(self.options.min_confidence) or lone.get(name)
            self.reasons.pop(name, None)
            if reason:
                self.reasons[name] = reason
        return found

    def _shared_cameras(self, localizer: Localizer, names: list[str]) -> dict[str, QueryCamera]:
        features = self.photos.extracted.features
        return share_cameras(
            {name: self.photos.cameras[name] for name in names},
            lambda some: [
                localizer.localize_features(features[name], self.photos.cameras[name]) for name in some
            ],
        )

    def _enter(self, found: Mapping[str, SearchResult]) -> set[str]:
        """Extend the map by photos whose poses are sure; returns those that its matches bear out."""
        places = {name: _place(one) for name, one in sorted(found.items())}
        neighbors = likely_neighbors(self.map, places)
        cameras = {name: one.camera for name, one in places.items()}
        matches = match_new(
            self.map,
            self.photos,
            cameras,
            neighbors,
            matcher=self.options.matcher,
            seed=self.options.seed,
            workers=self.workers,
            progress=self.progress,
        )
        new = {name: self._new_image(name, found[name]) for name in places}
        while new:
            among = {
                pair: one for pair, one in matches.items() if set(pair) <= new.keys() | self.map.images.keys()
            }
            larger = self._extended(new, among)
            doubts = _unsupported(self.map, larger, new, among)
            self.reasons |= doubts
            if not doubts:
                self.map = larger
                return set(new)
            new = {name: one for name, one in new.items() if name not in doubts}
        return set()

    def _new_image(self, name: str, found: SearchResult) -> NewImage:
        pose = found.best.pose
        if pose is None:
            raise ValueError(f"{name} has no pose")
        camera = copy(found.best.camera)
        camera.camera_id = self._camera_id(camera)
        return NewImage(
            features=self.photos.extracted.features[name],
            camera=camera,
            cam_from_world=pose.cam_from_world,
            colors=self.photos.extracted.colors[name],
        )

    def _camera_id(self, camera: pycolmap.Camera) -> int:
        """The id of a camera of the map with these intrinsics, or of a new one."""
        key = camera_key(camera)
        known = {camera_key(one): i for i, one in sorted(self.map.model.cameras.items(), reverse=True)}
        if key in known:
            return known[key]
        following = 1 + max([*self.map.model.cameras, *self._cameras.values()])
        return self._cameras.setdefault(key, following)

    def _extended(self, new: Mapping[str, NewImage], matches: Mapping[tuple[str, str], IndexPairs]) -> Map:
        """The larger map, with intrinsics refined that were estimated, if the result is possible."""
        guessed = {
            one.camera.camera_id
            for name, one in new.items()
            if self.photos.cameras[name].source not in _TRUSTED
            and not self.map.model.exists_camera(one.camera.camera_id)
        }
        larger = extend_map(self.map, new, matches, refined_cameras=guessed, seed=self.options.seed)
        if any(camera_fault(larger.model.camera(i)) for i in guessed):
            return extend_map(self.map, new, matches, seed=self.options.seed)
        return larger


def _lone_cameras(
    found: Mapping[str, SearchResult], cameras: Mapping[str, QueryCamera], believed: int
) -> dict[str, str]:
    """Photos whose matches contradict the camera of the map, though most others of that camera agree with it.

    They would enter with a camera of their own, and the camera of photos that come later would be unknown.
    `believed` is the number of photos that have entered with the camera of the map.
    """
    posed = [name for name, one in found.items() if one.best.pose and cameras[name].source in _TRUSTED]
    alone = [name for name in posed if _estimated(found[name])]
    if 2 * len(alone) > len(posed) + believed:
        return {}
    return {
        name: f"its matches contradict the camera of the map: {', '.join(_estimated(found[name]))}"
        for name in alone
    }


def _estimated(found: SearchResult) -> tuple[str, ...]:
    return found.best.pose.estimated if found.best.pose else ()


def _place(found: SearchResult) -> LocalizedImage:
    best = found.best
    if best.pose is None:
        raise ValueError("there is no pose")
    return LocalizedImage(
        cam_from_world=best.pose.cam_from_world,
        camera=best.camera,
        points=np.unique(best.matches.points[best.pose.inliers]),
    )


def _unsupported(
    before: Map, larger: Map, new: Mapping[str, NewImage], matches: Mapping[tuple[str, str], IndexPairs]
) -> dict[str, str]:
    """Why new images are not borne out by their matches with images that were in the map."""
    shares = agreement(larger.images, matches)
    old = {image.image_id for name, image in before.images.items()}
    found = {}
    for name in sorted(new):
        of_old = {
            pair: share for pair, share in shares.items() if name in pair and not set(pair) <= new.keys()
        }
        agreeing = sum(share >= MIN_AGREEING for share in of_old.values())
        common = _common(larger, name, old)
        if 2 * agreeing < len(of_old):
            found[name] = (
                f"its matches with {len(of_old) - agreeing} of {len(of_old)} images contradict its pose"
            )
        elif common < MIN_COMMON_POINTS:
            found[name] = f"it sees only {common} points that images of the map see"
    return found


def _common(larger: Map, name: str, old: set[int]) -> int:
    """Number of points that an image sees with any of the old ones."""
    points = larger.model.points3D
    seen = larger.point3D_ids[larger.observations[name].points].tolist()
    return sum(any(one.image_id in old for one in points[i].track.elements) for i in seen)
