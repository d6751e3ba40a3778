"""Predict how a reduced map localizes queries: its references, each left out in turn, serve as queries.

A reference whose own observations are removed from the map is a query of known pose. The errors, inliers and
times of localizing many of them predict those of real queries. Queries resemble the references less than
these resemble each other, so each test is handicapped: a random share of its correct matches, between none
and half, is removed. Under rough conditions, each test is also blurred and partly hidden, see `disturbance`.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from time import perf_counter

import numpy as np
import pycolmap
from jaxtyping import Float64
from scipy.sparse import csr_array
from threadpoolctl import threadpool_limits

from slimsfm.arrays import Ids, Mask, Points2D, Points3D, evenly_spaced
from slimsfm.geometry import corner_error, reprojection_errors, resized_camera
from slimsfm.localization import Seconds
from slimsfm.localization.extraction import SMALLEST_SCALE_PX, Window
from slimsfm.localization.matching import match_target, reference_target
from slimsfm.localization.strategy import PointMatches, Target, unite
from slimsfm.mapping.descriptors import quantize
from slimsfm.mapping.map import Map, observed
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose
from slimsfm.pose.types import MIN_SIGMA_PX
from slimsfm.progress import ProgressBar, silent
from slimsfm.reduction.disturbance import GOLDEN, ROUGH, Conditions, Disturbance, Keypoints, disturbed
from slimsfm.reduction.image_size import SizedTests, SizeTrials
from slimsfm.selection.usable_points import LeftOut

Targets = Callable[[str], list[Target]]
"""What a test of this name is matched with."""

_MOST_TESTS = 60
_LOST = 0.5  # largest share of correct matches that is removed
_MOST_REFERENCES = 60  # matched per test with the full map: those with the most common points


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """How well references that are left out are localized."""

    tests: tuple[str, ...]
    """Names of the references that served as queries."""

    errors: Float64[np.ndarray, " tests"]
    """Relative corner error of each test; infinite without a pose."""

    inliers: Ids
    """Number of inliers of each test; 0 without a pose."""

    seconds: Seconds
    """Median time of each stage per query; NaN for an extraction that is not known."""

    rough_errors: Float64[np.ndarray, "tests disturbances"]
    """Relative corner error of each test after each disturbance; no columns if none was tried."""

    finest_error: float = 0.0
    """Relative corner error that half a pixel amounts to at the distance of the points, the median over the
    map's tests: no detector is more accurate, so smaller errors count as equal."""

    def within(self, fraction: float) -> float:
        """Percentage of the tests whose relative corner error is below a fraction."""
        return 100 * float(np.mean(self.errors < fraction)) if len(self.errors) else 0.0

    def rough_within(self, fraction: float) -> tuple[float, ...]:
        """For each disturbance, the percentage of the tests whose error is below a fraction."""
        right = self.rough_errors < fraction
        return tuple(100 * float(np.mean(column)) if len(column) else 0.0 for column in right.T)

    def in_rounds(self, sizes: SizeTrials | None) -> "Prediction":
        """The prediction with the time of extraction in rounds; the same if sizes cannot be tried."""
        if sizes is None:
            return self
        return replace(self, seconds=replace(self.seconds, extract=sizes.default_seconds()))

    def of(self, tests: Collection[str]) -> "Prediction":
        """The prediction restricted to some tests; the time remains that of all."""
        rows = [row for row, name in enumerate(self.tests) if name in tests]
        return replace(
            self,
            tests=tuple(self.tests[row] for row in rows),
            errors=self.errors[rows],
            inliers=self.inliers[rows],
            rough_errors=self.rough_errors[rows],
        )

    @property
    def median_error(self) -> float:
        """Median relative corner error."""
        return float(np.median(self.errors)) if len(self.errors) else np.inf

    @property
    def p90_error(self) -> float:
        """90th percentile of the relative corner error; infinite if more than a tenth have no pose."""
        return float(np.quantile(self.errors, 0.9, method="higher")) if len(self.errors) else np.inf


@dataclass(frozen=True, kw_only=True)
class _Trial:
    error: float
    inliers: int
    match_seconds: float
    pose_seconds: float
    rough: tuple[float, ...]


class Trials:
    """Localizes references of a map as if they had never been part of it.

    Args:
        map: The full map.
        left_out: The map without each of its images.
        conditions: Which queries to predict.
        extract_seconds: Time of extracting features from a query that is shrunk to a longer side, or from
            the whole one (None); NaN if it is not known.
        clock: Measures matching and pose, in seconds.
    """

    def __init__(
        self,
        map: Map,
        left_out: LeftOut,
        *,
        conditions: Conditions = "rough",
        extract_seconds: Callable[[int | None], float] = lambda _: np.nan,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        self._map = map
        self._left_out = left_out
        self._matching = map.descriptor_metric
        self._disturbances = ROUGH if conditions == "rough" else ()
        self._extract_seconds = extract_seconds
        self._clock = clock
        names = [name for name in map.images if name not in map.info.wrong_poses]
        most = _MOST_TESTS if map.has_keypoints else 0  # a query has no descriptors
        self.tests = tuple(names[place] for place in evenly_spaced(len(names), most))
        sees = observed(map).astype(np.int32)
        self._common = csr_array(sees @ sees.T)
        self._finest_error = float(np.median([_half_pixel(map, name) for name in self.tests] or [0.0]))

    def point_targets(self, points: Ids) -> Targets:
        """What tests are matched with if some points are kept."""
        return lambda name: [self._described(points, name)]

    def image_targets(self, names: Collection[str]) -> Targets:
        """What tests are matched with if some references are kept."""
        chosen = {name: self._reference(name) for name in sorted(names)}
        return lambda test: [one for name, one in chosen.items() if name != test]

    def points(self, points: Ids) -> Prediction:
        """Match directly against some points, given as ascending rows of the map's points."""
        return self._predict(self.tests, self.point_targets(points))

    def images(self, names: Collection[str]) -> Prediction:
        """Match against some references; only the other references are tests."""
        return self._predict([name for name in self.tests if name not in names], self.image_targets(names))

    def full(self, tests: Collection[str], progress: ProgressBar = silent) -> Prediction:
        """Match some of the tests against all other references.

        If there are more than 60, only the nearest are matched, and the times of matching and pose are scaled
        up.
        """
        used = min(_MOST_REFERENCES, len(self._map.images) - 1)
        found = self._predict(progress(list(tests), "localize with the full map"), self._nearest)
        factor = (len(self._map.images) - 1) / max(used, 1)
        seconds = replace(found.seconds, match=factor * found.seconds.match, pose=factor * found.seconds.pose)
        return replace(found, seconds=seconds)

    def _predict(self, tests: Iterable[str], targets: Targets) -> Prediction:
        names, found = [], []
        with threadpool_limits(1):  # products on several threads may round differently
            for name in tests:
                names.append(name)
                found.append(self._try(name, targets(name)))
        return Prediction(
            tests=tuple(names),
            errors=np.array([one.error for one in found], np.float64),
            inliers=np.array([one.inliers for one in found], np.int64),
            seconds=Seconds(
                extract=self._extract_seconds(None),
                match=float(np.median([one.match_seconds for one in found] or [0.0])),
                pose=float(np.median([one.pose_seconds for one in found] or [0.0])),
            ),
            rough_errors=np.array([one.rough for one in found], np.float64).reshape(
                len(found), len(self._disturbances)
            ),
            finest_error=self._finest_error,
        )

    def _try(self, name: str, targets: list[Target]) -> _Trial:
        start = self._clock()
        query = self._left_out.query(name)
        matches = unite([match_target(query.descriptors, target, self._matching) for target in targets])
        match_seconds = self._clock() - start
        # limits in pixels are for those in which features were found
        matched = self._matched(name, matches, self._map.shrink_factor(name))
        start = self._clock()
        pose = matched.pose(matched.kept, matched.keypoints.pixels[matched.rows])
        pose_seconds = self._clock() - start
        rough = [matched.disturbed_pose(one, self.tests.index(name)) for one in self._disturbances]
        return _Trial(
            error=self._error(name, pose),
            inliers=pose.num_inliers if pose else 0,
            match_seconds=match_seconds,
            pose_seconds=pose_seconds,
            rough=tuple(self._error(name, one) for one in rough),
        )

    def sizes(self, targets: Targets) -> SizeTrials | None:
        """Try image sizes for the queries of a reduced map.

        Returns:
            The trials; None if the extractor has no image size or no scales, or nothing can be left out.
        """
        largest = self._map.info.extractor_options.get("max_image_size")
        if largest is None or not self.tests or self._left_out.query(self.tests[0]).scales is None:
            return None
        sides = [max(camera.width, camera.height) for camera in map(self._map.camera, self._map.images)]
        return SizeTrials(
            SizedTests(
                whole=min(int(np.median(sides)), largest),
                names=self.tests,
                localize=lambda name, size: self._pose_at(name, targets(name), size),
                share=self._shown,
                predicted_error=lambda pose: pose.predicted_corner_error(self._map.box),
                extract_seconds=self._extract_seconds,
            )
        )

    def _shown(self, name: str) -> float:
        """Share of a test's image that shows points of the map."""
        camera, seen = self._map.camera(name), self._map.observations[name]
        pixels = self._left_out.query(name).keypoints[seen.rows]
        window = Window.around(pixels, camera.width, camera.height)
        return window.area / (camera.width * camera.height) if window else 1.0

    def _pose_at(self, name: str, targets: list[Target], size: int) -> PoseEstimate | None:
        """Localize a test by the keypoints of an image whose longer side has `size` pixels."""
        query, camera = self._left_out.query(name), self._map.camera(name)
        factor = max(1.0, max(camera.width, camera.height) / size)
        scales = np.full(len(query.keypoints), np.inf) if query.scales is None else query.scales
        found = np.flatnonzero(scales >= SMALLEST_SCALE_PX * factor)
        matches = unite([match_target(query.descriptors[found], one, self._matching) for one in targets])
        matched = self._matched(name, replace(matches, keypoints=found[matches.keypoints]), factor)
        return matched.pose(matched.kept, matched.keypoints.pixels[matched.rows])

    def _matched(self, name: str, matches: PointMatches, factor: float) -> "_Matched":
        query, camera = self._left_out.query(name), self._map.camera(name)
        if factor > 1:
            camera = resized_camera(camera, 1 / factor)
        keypoints = Keypoints(
            pixels=query.keypoints / factor,
            scales=None if query.scales is None else query.scales / factor,
            size=(camera.width, camera.height),
        )
        points3D = self._map.points3D_in_world[matches.points]
        true_pose = self._map.images[name].cam_from_world()
        errors = reprojection_errors(keypoints.pixels[matches.keypoints], points3D, true_pose, camera)
        return _Matched(
            keypoints=keypoints,
            rows=matches.keypoints,
            points3D=points3D,
            wrong=errors > RansacOptions().max_error_px,
            kept=handicap(errors, self.tests.index(name)),
            camera=camera,
        )

    def _error(self, name: str, pose: PoseEstimate | None) -> float:
        if pose is None:
            return np.inf
        return corner_error(pose.cam_from_world, self._map.images[name].cam_from_world(), self._map.box)

    def _described(self, points: Ids, name: str) -> Target:
        descriptors, known = self._left_out.describe(points, name)
        return quantize(descriptors).restore(), known

    def among(self, tests: Collection[str], names: Collection[str], *, most: int) -> Prediction:
        """Match some of the tests against the nearest of some references, without themselves.

        Args:
            tests: Some of `tests`.
            names: The references.
            most: How many of them a test is matched with: those with the most common points.
        """
        return self._predict(tests, lambda test: self._nearest(test, names, most))

    def _nearest(
        self, name: str, among: Collection[str] | None = None, most: int = _MOST_REFERENCES
    ) -> list[Target]:
        names = list(self._map.images)
        row = names.index(name)
        others = slice(self._common.indptr[row], self._common.indptr[row + 1])
        images = self._common.indices[others]
        best = np.argsort(np.negative(self._common.data[others]), kind="stable")
        allowed = [i for i in images[best] if i != row and (among is None or names[i] in among)]
        return [self._reference(names[i]) for i in allowed[:most]]

    @lru_cache(maxsize=4 * _MOST_REFERENCES)  # noqa: B019, trials are few and short-lived
    def _reference(self, name: str) -> Target:
        return reference_target(self._map, name)


def _half_pixel(map: Map, name: str) -> float:
    """What half a pixel, of those in which features are found, is at the points of an image, in diagonals."""
    seen = map.points3D_in_world[map.observations[name].points]
    depths = (map.images[name].cam_from_world() * seen)[:, 2]
    if not len(depths):
        return 0.0
    focal_px = map.camera(name).mean_focal_length() / map.shrink_factor(name)
    return MIN_SIGMA_PX * float(np.median(depths)) / (focal_px * map.box.diagonal)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Matched:
    """A test with its matches, in pixels in which features were found."""

    keypoints: Keypoints
    rows: Ids
    points3D: Points3D
    wrong: Mask
    kept: Mask
    camera: pycolmap.Camera

    def pose(self, used: Mask, pixels: Points2D) -> PoseEstimate | None:
        return estimate_pose(pixels[used], self.points3D[used], self.camera)

    def disturbed_pose(self, disturbance: Disturbance, test: int) -> PoseEstimate | None:
        remain, pixels = disturbed(self.keypoints, self.rows, self.wrong, disturbance, test)
        return self.pose(self.kept & remain, pixels)


def handicap(errors_px: Float64[np.ndarray, " n"], test: int) -> Mask:
    """Decide which matches of a test are kept: those that a less similar query would have had as well.

    Args:
        errors_px: Reprojection error of each match at the true pose. Wrong matches are always kept.
        test: Number of the test; it determines the share that is removed, and which matches.
    """
    share = 1 - _LOST * (test * GOLDEN % 1)
    drawn = np.random.default_rng(test).random(len(errors_px)) < share
    return drawn | (errors_px > RansacOptions().max_error_px)
