"""Match a query in rounds until its pose is sure and accurate, or nothing is left to try."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from itertools import islice
from time import perf_counter

import numpy as np
import pycolmap

from slimsfm.geometry import project
from slimsfm.localization.cameras import CameraSource, FocalLength, QueryCamera
from slimsfm.localization.exact import ExactPass
from slimsfm.localization.extraction import Extracted, Window
from slimsfm.localization.matching import match_near
from slimsfm.localization.point_descriptors import PointSizes, distinct_points
from slimsfm.localization.round_result import (
    SURE,
    RoundResult,
    SearchResult,
    needs_refuting,
    suffices,
    summed,
)
from slimsfm.localization.rounds import Levels, Seen
from slimsfm.localization.shrunk import Shrunk
from slimsfm.localization.sight import Sight
from slimsfm.localization.strategy import PointMatches, PoseGuided, Query, Strategy
from slimsfm.localization.verification import Verifier, inflation
from slimsfm.mapping.map import Map
from slimsfm.pose import FocalPrior, Gravity, PoseEstimate, RansacOptions, estimate_pose
from slimsfm.pose.camera_fit import FOCAL_LENGTH, fit_camera, with_check
from slimsfm.threads import one_blas_thread

CONVINCING = 0.5
"""Confidence from which a pose is made exact: matches near a wrong pose are worth nothing."""

TRUSTED: tuple[CameraSource, ...] = ("given", "map", "queries")
"""Sources of intrinsics that are taken as known as long as no matches contradict them."""

_COARSE_ROUNDS = 4  # of matching, with features of a shrunken image
_BELIEVED = 0.3  # confidence from which a pose says where to look
_MORE = 1.3  # times the inliers that a pose with another focal length must have
_AS_MANY = 0.9  # times the inliers, if they contradict the given one
_APPROXIMATE = 0.3  # largest relative error of an approximate focal length


class Search:
    """Searches one map with one strategy."""

    def __init__(
        self,
        map: Map,
        strategy: Strategy,
        ransac: RansacOptions,
        focal: FocalLength = "auto",
        *,
        is_exact: bool = True,
        matches_much: bool = False,
    ) -> None:
        """Prepare for a map; the other arguments are those of `LocalizationOptions`.

        Args:
            map: The map.
            strategy: How queries are matched.
            ransac: How poses are estimated.
            focal: How far focal lengths are believed.
            is_exact: Whether sure poses are refined by the exact pass.
            matches_much: Whether the strategy matches so much that it gains from several threads.
        """
        self._map = map
        self._strategy = strategy
        self._ransac = ransac
        self._focal: FocalLength = focal
        sizes = PointSizes(map)
        self._verifier = Verifier(map, strategy, distinct_points(map), sizes)
        self._sight = Sight(map)
        self._exact, self._is_exact = ExactPass(map, strategy, sizes), is_exact
        self._threads = nullcontext if matches_much else one_blas_thread

    def run(
        self,
        levels: Levels,
        prepare: Callable[[Extracted], Query],
        camera: QueryCamera,
        gravity: Gravity | None = None,
    ) -> SearchResult:
        """Localize a query by its features, from coarse to fine, and make its pose exact.

        Args:
            levels: Extracts the features.
            prepare: Makes a query of them.
            camera: The intrinsics.
            gravity: Direction of gravity.
        """
        with self._threads():
            return self._exact_result(self._searched(levels, prepare, camera, gravity), gravity)

    def _exact_result(self, found: SearchResult, gravity: Gravity | None) -> SearchResult:
        start = perf_counter()
        if not self._is_exact or found.best.confidence < CONVINCING or gravity is not None:
            return found
        best = self._refined(found.best)
        return replace(found, best=best, pose_seconds=found.pose_seconds + perf_counter() - start)

    def _refined(self, best: RoundResult) -> RoundResult:
        """The same pose, more exact: see `ExactPass`."""
        if best.pose is None or best.evidence is None:
            return best
        shrunk = Shrunk.of(best.query, best.matches, best.camera)
        found = self._exact.refined(
            shrunk.query, shrunk.matches, best.pose, shrunk.camera, self._ransac.max_error_px
        )
        if found is None:
            return best
        evidence = self._verifier.determined(best.evidence, found.pose)
        pose = replace(found.pose, confidence=evidence.confidence)
        return replace(best, matches=found.matches, pose=pose, evidence=evidence)

    def _searched(
        self,
        levels: Levels,
        prepare: Callable[[Extracted], Query],
        camera: QueryCamera,
        gravity: Gravity | None,
    ) -> SearchResult:
        """The first round that suffices, or all rounds."""
        rounds, level = [], next(levels)
        while True:
            is_coarse = not level.is_last
            matching = self.rounds(prepare(level.extracted), camera, gravity)
            for one in islice(matching, _COARSE_ROUNDS if is_coarse else None):
                rounds.append(one)
                if suffices(rounds, is_coarse=is_coarse) and not needs_refuting(one):
                    return summed(rounds)
            if level.is_last:
                break
            if suffices(rounds, is_coarse=True):  # a larger image has no more references
                return summed(rounds)
            try:
                level = levels.send(self._seen(rounds[-1]))
            except StopIteration:
                return summed(rounds)
        is_sure = rounds and rounds[-1].confidence >= SURE
        if rounds and not is_sure and self._focal == "auto" and camera.source in TRUSTED:
            rounds.append(self._with_any_focal_length(rounds[-1], camera, gravity))
        return summed(rounds)

    def _seen(self, last: RoundResult) -> Seen:
        """Where the map's points are in the image, as far as the pose is believed."""
        if last.pose is None or last.evidence is None or last.confidence < _BELIEVED:
            return Seen()
        agreeing = last.matches.points[last.pose.inliers]
        points = np.union1d(agreeing, self._strategy.visible_points(last.pose.cam_from_world, agreeing)[1])
        pixels = project(self._map.points3D_in_world[points], last.pose.cam_from_world, last.camera)
        window = Window.around(pixels, last.camera.width, last.camera.height)
        return Seen(window, is_sure=last.evidence.confidence_in_matches >= SURE)

    def _with_any_focal_length(
        self, last: RoundResult, camera: QueryCamera, gravity: Gravity | None
    ) -> RoundResult:
        """The last round again, as if nobody knew the focal length; the round itself if that is no better."""
        unknown = replace(camera, source="unknown")
        again = self._result(last.query, last.matches, unknown, perf_counter(), gravity)
        inliers = [one.pose.num_inliers if one.pose else 0 for one in (last, again)]
        needed = _MORE if last.evidence is None or last.evidence.misfit < 1 else _AS_MANY
        if inliers[1] > needed * inliers[0] and again.confidence > last.confidence:
            return again
        return replace(last, match_seconds=0.0, pose_seconds=again.pose_seconds)

    def near(self, query: Query, camera: QueryCamera, near_cam_from_world: pycolmap.Rigid3d) -> SearchResult:
        """Localize a query of approximately known pose: match points near where they project."""
        start = perf_counter()
        with self._threads():
            matches = self._near(query, camera.camera, near_cam_from_world)
            return summed([self._result(query, matches, camera, start)])

    def _near(
        self, query: Query, camera: pycolmap.Camera, near_cam_from_world: pycolmap.Rigid3d
    ) -> PointMatches:
        if isinstance(self._strategy, PoseGuided):
            return self._strategy.near(query, near_cam_from_world)
        target = self._strategy.visible_points(near_cam_from_world)
        pixels = project(self._map.points3D_in_world[target[1]], near_cam_from_world, camera)
        return match_near(query, target, pixels, camera, self._map.descriptor_metric)

    def rounds(
        self, query: Query, camera: QueryCamera, gravity: Gravity | None = None
    ) -> Iterator[RoundResult]:
        """Run all rounds of the strategy."""
        matching, pose = self._strategy.rounds(query), None
        while True:
            start = perf_counter()
            try:
                matches = matching.send(pose)
            except StopIteration:
                return
            result = self._result(query, matches, camera, start, gravity)
            pose = result.pose
            yield result

    def _result(
        self,
        query: Query,
        matches: PointMatches,
        camera: QueryCamera,
        start: float,
        gravity: Gravity | None = None,
    ) -> RoundResult:
        matched = perf_counter()
        shrunk = Shrunk.of(query, matches, camera.camera)
        pose = self._estimate(shrunk, camera.source, gravity)
        estimated, evidence = camera.camera, None
        if pose is not None:
            used = pose.camera or shrunk.camera
            evidence = self._verifier.evidence(
                shrunk.query, shrunk.matches, pose, used, calibrated=camera.source == "given"
            )
            if pose.camera is not None:
                estimated = shrunk.enlarged(pose.camera)
            pose = replace(pose, confidence=evidence.confidence, camera=pose.camera and estimated)
        return RoundResult(
            query=query,
            matches=matches,
            pose=pose,
            camera=estimated,
            evidence=evidence,
            match_seconds=matched - start,
            pose_seconds=perf_counter() - matched,
        )

    def _estimate(self, shrunk: Shrunk, source: CameraSource, gravity: Gravity | None) -> PoseEstimate | None:
        """The pose, with the intrinsics as far as they are believed; those that do not fit are estimated.

        None if there is none that the map allows: every result is decided on here.
        """
        points2D = shrunk.matches.pixels(shrunk.query)
        points3D = self._map.points3D_in_world[shrunk.matches.points]
        focal = self._prior(shrunk.camera, source)
        pose = estimate_pose(points2D, points3D, shrunk.camera, self._ransac, focal=focal, gravity=gravity)
        if pose is None:
            return None
        pose = pose if focal is None else replace(pose, estimated=(FOCAL_LENGTH,))
        if self._focal == "known":
            pose = with_check(points2D, points3D, pose, shrunk.camera, self._ransac)
        else:
            pose = fit_camera(
                points2D, points3D, pose, shrunk.camera, self._ransac, focal=focal, gravity=gravity
            )
        if not self._sight.allows(pose, points3D, pose.camera or shrunk.camera):
            return None
        factor = inflation(pose.estimated)
        return replace(pose, covariance=None if pose.covariance is None else factor**2 * pose.covariance)

    def _prior(self, camera: pycolmap.Camera, source: CameraSource) -> FocalPrior | None:
        """What is expected of the focal length; None where it is known."""
        if self._focal == "known" or (self._focal == "auto" and source in TRUSTED):
            return None
        if self._focal == "unknown" or source == "unknown":
            return FocalPrior.of(camera)
        return (
            FocalPrior.of(camera, _APPROXIMATE) if self._focal == "approximate" else FocalPrior.near(camera)
        )
