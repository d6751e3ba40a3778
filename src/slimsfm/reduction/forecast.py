"""What a slim map will do to queries, told beforehand: the references stand in for them.

A reference whose own observations are taken out of a map is a query of known pose. Errors, inliers and times
of localizing many of them foretell those of queries. Queries are less like the references than those are like
each other, so each test is handicapped: a random part of its right matches, none to half, is taken away.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from time import perf_counter

import numpy as np
from jaxtyping import Float64
from scipy.sparse import csr_array
from threadpoolctl import threadpool_limits

from slimsfm.arrays import Ids, Mask, Points2D, Points3D
from slimsfm.geometry import corner_error, reprojection_errors
from slimsfm.localization.matching import match_target, reference_target
from slimsfm.localization.strategy import Target, unite
from slimsfm.mapping.descriptors import quantize
from slimsfm.mapping.map import Map, observed
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose
from slimsfm.progress import ProgressBar, silent
from slimsfm.selection.leave_one_out import LeftOut

_MOST_TESTS = 60
_LOST = 0.5  # of the right matches of a test, at most
_GOLDEN = (5**0.5 - 1) / 2  # its multiples fill the unit interval evenly
_MOST_REFERENCES = 60  # that a test is matched against; of more, those of most common points


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """How references that are left out are localized."""

    tests: tuple[str, ...]
    """The references that served as queries."""

    errors: Float64[np.ndarray, " tests"]
    """Relative corner error of each; infinite where there was no pose."""

    inliers: Ids
    """Inliers of each; 0 where there was no pose."""

    seconds: float
    """Mean time of matching and pose a query."""

    def within(self, fraction: float) -> float:
        """Percentage of the tests within a fraction of the diagonal."""
        return 100 * float(np.mean(self.errors < fraction)) if len(self.errors) else 0.0

    def of(self, tests: Collection[str]) -> "Prediction":
        """The part that speaks of some of the tests; the time stays that of all."""
        rows = [row for row, name in enumerate(self.tests) if name in tests]
        return replace(
            self,
            tests=tuple(self.tests[row] for row in rows),
            errors=self.errors[rows],
            inliers=self.inliers[rows],
        )

    @property
    def median_error(self) -> float:
        """Median relative corner error."""
        return float(np.median(self.errors)) if len(self.errors) else np.inf


@dataclass(frozen=True, kw_only=True)
class _Trial:
    error: float
    inliers: int
    seconds: float


class Trials:
    """Localizes references of a map as if they had never been part of it."""

    def __init__(self, map: Map, left_out: LeftOut) -> None:
        self._map = map
        self._left_out = left_out
        self._matching = map.descriptor_metric
        names = list(map.images)
        most = _MOST_TESTS if map.has_keypoints else 0  # a query has no descriptors
        places = np.linspace(0, len(names) - 1, min(most, len(names))).round().astype(int)
        self.tests = tuple(names[place] for place in places)
        sees = observed(map).astype(np.int32)
        self._common = csr_array(sees @ sees.T)

    def points(self, points: Ids) -> Prediction:
        """Match directly against some points, rows of the map's points in ascending order."""
        return self._predict(self.tests, lambda name: [self._described(points, name)])

    def images(self, names: Collection[str]) -> Prediction:
        """Match against some references; only the others are tests."""
        chosen = [self._reference(name) for name in sorted(names)]
        return self._predict([name for name in self.tests if name not in names], lambda _: chosen)

    def full(self, tests: Collection[str], progress: ProgressBar = silent) -> Prediction:
        """Match some of the tests against all other references.

        Where these are many, just the nearest are matched, and the time is scaled up.
        """
        used = min(_MOST_REFERENCES, len(self._map.images) - 1)
        found = self._predict(progress(list(tests), "localize with the full map"), self._nearest)
        return replace(found, seconds=found.seconds * (len(self._map.images) - 1) / max(used, 1))

    def _predict(self, tests: Iterable[str], targets: Callable[[str], list[Target]]) -> Prediction:
        names, found = [], []
        with threadpool_limits(1):  # products on several threads may round otherwise: no choice hangs on that
            for name in tests:
                names.append(name)
                found.append(self._try(name, targets(name)))
        return Prediction(
            tests=tuple(names),
            errors=np.array([one.error for one in found], np.float64),
            inliers=np.array([one.inliers for one in found], np.int64),
            seconds=float(np.mean([one.seconds for one in found])) if found else 0.0,
        )

    def _try(self, name: str, targets: list[Target]) -> _Trial:
        query, camera = self._left_out.query(name), self._map.camera(name)
        start = perf_counter()
        matches = unite([match_target(query.descriptors, target, self._matching) for target in targets])
        seconds = perf_counter() - start
        points2D = query.keypoints[matches.keypoints]
        points3D = self._map.points3D_in_world[matches.points]
        kept = self._handicap(name, points2D, points3D)
        start = perf_counter()
        pose = estimate_pose(points2D[kept], points3D[kept], camera)
        seconds += perf_counter() - start
        error, inliers = self._error(name, pose), pose.num_inliers if pose else 0
        return _Trial(error=error, inliers=inliers, seconds=seconds)

    def _handicap(self, name: str, points2D: Points2D, points3D_in_world: Points3D) -> Mask:
        """Which matches a query less like the references would have had as well."""
        pose = self._map.images[name].cam_from_world()
        errors = reprojection_errors(points2D, points3D_in_world, pose, self._map.camera(name))
        place = self.tests.index(name)
        share = 1 - _LOST * (place * _GOLDEN % 1)
        drawn = np.random.default_rng(place).random(len(points2D)) < share
        return drawn | (errors > RansacOptions().max_error_px)

    def _error(self, name: str, pose: PoseEstimate | None) -> float:
        if pose is None:
            return np.inf
        return corner_error(pose.cam_from_world, self._map.images[name].cam_from_world(), self._map.box)

    def _described(self, points: Ids, name: str) -> Target:
        descriptors = self._left_out.describe(points, name)
        known = descriptors.any(axis=1)
        return quantize(descriptors[known]).restore(), points[known]

    def _nearest(self, name: str) -> list[Target]:
        names = list(self._map.images)
        row = names.index(name)
        others = slice(self._common.indptr[row], self._common.indptr[row + 1])
        images = self._common.indices[others]
        best = np.argsort(np.negative(self._common.data[others]), kind="stable")
        nearest = [i for i in images[best] if i != row][:_MOST_REFERENCES]
        return [self._reference(names[i]) for i in nearest]

    @lru_cache(maxsize=4 * _MOST_REFERENCES)  # noqa: B019, trials are few and short-lived
    def _reference(self, name: str) -> Target:
        return reference_target(self._map, name)
