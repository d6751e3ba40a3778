"""Match a query in rounds until its pose is sure and exact, or nothing is left to try."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from time import perf_counter
from typing import NamedTuple

import pycolmap

from slimsfm.focal import estimate_pose_and_focal
from slimsfm.geometry import project
from slimsfm.gravity import Gravity, estimate_upright_pose
from slimsfm.localization.cameras import FocalLength
from slimsfm.localization.guided_matching import match_near
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.localization.strategy import PointMatches, PoseGuided, Query, Strategy
from slimsfm.localization.verification import Evidence, Verifier
from slimsfm.mapping.map import Map
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose

_SURE = 0.95  # confidence
_REFUTING = 2  # images that had the chance to contradict a pose whose inliers could be elsewhere
_EXACT = 0.006  # predicted relative corner error
_APPROXIMATE = 0.3  # by which an approximate focal length may be off
_SETTLED = 0.8  # of the error of the round before: more matches no longer help much


@dataclass(frozen=True, kw_only=True, eq=False)
class RoundResult:
    """What one round gave."""

    matches: PointMatches
    """All matches so far."""

    pose: PoseEstimate | None
    """The pose that they give, with its confidence."""

    camera: pycolmap.Camera
    """The intrinsics; with the focal length that was found where it was not known."""

    evidence: Evidence | None
    """What the confidence rests on; None where there is no pose."""

    match_seconds: float
    """Wall time of matching in this round."""

    pose_seconds: float
    """Wall time of estimating and verifying the pose."""

    @property
    def confidence(self) -> float:
        """That of the pose; below zero where there is none."""
        return -1.0 if self.pose is None else self.pose.confidence or 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchResult:
    """The attempt that counts, and what all of them took."""

    best: RoundResult
    """The last that gave a pose: it knows all that those before knew, and what speaks against them."""

    references: int
    """Reference images that the query was matched with."""

    match_seconds: float
    """Wall time of matching."""

    pose_seconds: float
    """Wall time of estimating and verifying poses."""


class Search:
    """Searches one map with one strategy."""

    def __init__(
        self, map: Map, strategy: Strategy, ransac: RansacOptions, focal: FocalLength = "known"
    ) -> None:
        self._map = map
        self._strategy = strategy
        self._ransac = ransac
        self._focal: FocalLength = focal
        self._verifier = Verifier(map, strategy, map.point_descriptors or describe_points(map))

    def run(self, query: Query, camera: pycolmap.Camera, gravity: Gravity | None = None) -> SearchResult:
        """Localize a query: try until it is enough."""
        attempts: list[RoundResult] = []
        for attempt in self.attempts(query, camera, gravity):
            attempts.append(attempt)
            if _is_enough(attempts):
                break
        return _summed(attempts)

    def near(
        self, query: Query, camera: pycolmap.Camera, near_cam_from_world: pycolmap.Rigid3d
    ) -> SearchResult:
        """Localize a query that was taken about from there: points are sought near where they project."""
        start = perf_counter()
        if isinstance(self._strategy, PoseGuided):
            matches = self._strategy.near(query, near_cam_from_world)
        else:
            target = self._strategy.visible_points(near_cam_from_world)
            pixels = project(self._map.points3D_in_world[target[1]], near_cam_from_world, camera)
            matches = match_near(query, target, pixels, camera, self._map.descriptor_metric)
        return _summed([self._attempt(query, matches, camera, start)])

    def attempts(
        self, query: Query, camera: pycolmap.Camera, gravity: Gravity | None = None
    ) -> Iterator[RoundResult]:
        """Try everything, round by round."""
        rounds, pose = self._strategy.rounds(query), None
        while True:
            start = perf_counter()
            try:
                matches = rounds.send(pose)
            except StopIteration:
                return
            attempt = self._attempt(query, matches, camera, start, gravity)
            pose = attempt.pose
            yield attempt

    def _attempt(
        self,
        query: Query,
        matches: PointMatches,
        camera: pycolmap.Camera,
        start: float,
        gravity: Gravity | None = None,
    ) -> RoundResult:
        matched = perf_counter()
        posed = self._estimate(query, matches, camera, gravity)
        pose, evidence = posed.pose, None
        if pose is not None:
            evidence = self._verifier.evidence(query, matches, pose, posed.camera)
            pose = replace(pose, confidence=evidence.confidence)
        return RoundResult(
            matches=matches,
            pose=pose,
            camera=posed.camera,
            evidence=evidence,
            match_seconds=matched - start,
            pose_seconds=perf_counter() - matched,
        )

    def _estimate(
        self, query: Query, matches: PointMatches, camera: pycolmap.Camera, gravity: Gravity | None
    ) -> "_Posed":
        points2D, points3D = matches.pixels(query), self._map.points3D_in_world[matches.points]
        if self._focal == "known":
            if gravity is None:
                return _Posed(estimate_pose(points2D, points3D, camera, self._ransac), camera)
            return _Posed(estimate_upright_pose(points2D, points3D, camera, gravity, self._ransac), camera)
        uncertainty = _APPROXIMATE if self._focal == "approximate" else None
        found = estimate_pose_and_focal(
            points2D, points3D, camera, self._ransac, relative_uncertainty=uncertainty
        )
        return _Posed(found.pose, found.camera) if found else _Posed(None, camera)


class _Posed(NamedTuple):
    pose: PoseEstimate | None
    camera: pycolmap.Camera


def _is_enough(attempts: list[RoundResult]) -> bool:
    """Whether the last pose is sure, and exact or no longer becoming much more so."""
    last = attempts[-1].evidence
    if last is None or last.confidence < _SURE:
        return False
    if last.is_ambiguous and attempts[-1].matches.references < _REFUTING:
        return False
    before = attempts[-2].evidence if len(attempts) > 1 else None
    settled = before is not None and last.predicted_error > _SETTLED * before.predicted_error
    return settled or last.predicted_error <= _EXACT


def _summed(attempts: list[RoundResult]) -> SearchResult:
    return SearchResult(
        best=next((one for one in reversed(attempts) if one.pose), attempts[-1]),
        references=max(one.matches.references for one in attempts),
        match_seconds=sum(one.match_seconds for one in attempts),
        pose_seconds=sum(one.pose_seconds for one in attempts),
    )
