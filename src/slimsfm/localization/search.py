"""Match a query in rounds until its pose is sure and exact, or nothing is left to try."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from time import perf_counter

import pycolmap

from slimsfm.geometry import project
from slimsfm.localization.guided import match_near
from slimsfm.localization.strategy import PointMatches, Query, Strategy
from slimsfm.localization.verification import Evidence, Verifier
from slimsfm.mapping.map import Map
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose

_SURE = 0.95  # confidence
_EXACT = 0.006  # predicted relative corner error
_SETTLED = 0.8  # of the error of the round before: more matches no longer help much


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """What one round gave."""

    matches: PointMatches
    """All matches so far."""

    pose: PoseEstimate | None
    """The pose that they give, with its confidence."""

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
class Found:
    """The surest attempt, and what all of them took."""

    best: Attempt
    """The attempt of greatest confidence; of equal ones the last."""

    references: int
    """Reference images that the query was matched with."""

    match_seconds: float
    """Wall time of matching."""

    pose_seconds: float
    """Wall time of estimating and verifying poses."""


class Search:
    """Searches one map with one strategy."""

    def __init__(self, map: Map, strategy: Strategy, ransac: RansacOptions) -> None:
        self._map = map
        self._strategy = strategy
        self._ransac = ransac
        self._verifier = Verifier(map, strategy)

    def run(self, query: Query, camera: pycolmap.Camera) -> Found:
        """Localize a query: try until it is enough."""
        attempts: list[Attempt] = []
        for attempt in self.attempts(query, camera):
            attempts.append(attempt)
            if _is_enough(attempts):
                break
        return _summed(attempts)

    def near(self, query: Query, camera: pycolmap.Camera, near_cam_from_world: pycolmap.Rigid3d) -> Found:
        """Localize a query that was taken about from there: points are sought near where they project."""
        start = perf_counter()
        target = self._strategy.expected(near_cam_from_world)
        pixels = project(self._map.points3D_in_world[target[1]], near_cam_from_world, camera)
        attempt = self._attempt(query, match_near(query, target, pixels, camera), camera, start)
        return _summed([attempt])

    def attempts(self, query: Query, camera: pycolmap.Camera) -> Iterator[Attempt]:
        """Try everything, round by round."""
        rounds, pose = self._strategy.rounds(query), None
        while True:
            start = perf_counter()
            try:
                matches = rounds.send(pose)
            except StopIteration:
                return
            attempt = self._attempt(query, matches, camera, start)
            pose = attempt.pose
            yield attempt

    def _attempt(self, query: Query, matches: PointMatches, camera: pycolmap.Camera, start: float) -> Attempt:
        matched = perf_counter()
        pose, evidence = self._pose(query, matches, camera)
        return Attempt(
            matches=matches,
            pose=pose,
            evidence=evidence,
            match_seconds=matched - start,
            pose_seconds=perf_counter() - matched,
        )

    def _pose(
        self, query: Query, matches: PointMatches, camera: pycolmap.Camera
    ) -> tuple[PoseEstimate | None, Evidence | None]:
        points3D = self._map.points3D_in_world[matches.points]
        pose = estimate_pose(query.keypoints[matches.keypoints], points3D, camera, self._ransac)
        if pose is None:
            return None, None
        evidence = self._verifier.evidence(query, matches, pose, camera)
        return replace(pose, confidence=evidence.confidence), evidence


def _is_enough(attempts: list[Attempt]) -> bool:
    """Whether the last pose is sure, and exact or no longer becoming much more so."""
    last = attempts[-1].evidence
    if last is None or last.confidence < _SURE:
        return False
    before = attempts[-2].evidence if len(attempts) > 1 else None
    settled = before is not None and last.predicted_error > _SETTLED * before.predicted_error
    return settled or last.predicted_error <= _EXACT


def _summed(attempts: list[Attempt]) -> Found:
    return Found(
        best=max(reversed(attempts), key=lambda one: one.confidence),
        references=max(one.matches.references for one in attempts),
        match_seconds=sum(one.match_seconds for one in attempts),
        pose_seconds=sum(one.pose_seconds for one in attempts),
    )
