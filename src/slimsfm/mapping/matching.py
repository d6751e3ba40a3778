"""Match pairs of images by their features and verify the matches by two-view geometry, in any process."""

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
from threadpoolctl import threadpool_limits

from slimsfm.arrays import Descriptors, IndexPairs, Points2D
from slimsfm.features import Features, Matcher, match_many, match_nearest, unit_rows
from slimsfm.features.store import FeatureFile
from slimsfm.mapping.blocks import Workers
from slimsfm.mapping.orientation import turned_features
from slimsfm.mapping.pairs import Pairs
from slimsfm.mapping.scratch import Geometries, off_grid
from slimsfm.mapping.shrinking import shrunk_features
from slimsfm.mapping.workspace import Arrays, Workspace
from slimsfm.progress import ProgressBar, silent

_CACHED = 256  # images whose features a process keeps in memory
_LARGEST = 256  # features of an image that tell whether it may show the same as another one
_ALIKE = 8  # matches among them with which it may
_MATRICES = "E", "F", "H"


@dataclass(frozen=True, kw_only=True, eq=False)
class PairMatching:
    """How pairs of images are matched and verified."""

    features: Path
    """File of the features, in pixels of the images."""

    turns: Mapping[str, int]
    """Images whose features are turned before the verification, and how often."""

    factors: Mapping[str, float]
    """Pixels of the image per pixel of the shrunk image in which features were found."""

    cameras: Mapping[str, pycolmap.Camera]
    """Cameras of the shrunk and turned images."""

    matcher: Matcher
    """Matches the features of two images."""

    one_thread: bool
    """Whether the matcher runs on one thread and in several processes at a time; else in this one alone."""

    seed: int
    """Seed of the verification."""

    def of(self, pairs: Pairs) -> "PairMatching":
        """What matching some of the pairs needs."""
        names = {name for pair in pairs for name in pair}
        turns, factors, cameras = (
            {name: one[name] for name in names if name in one}
            for one in (self.turns, self.factors, self.cameras)
        )
        return replace(self, turns=turns, factors=factors, cameras=cameras)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Block:
    matching: PairMatching
    stamp: tuple[int, int]  # a worker that outlives a build must not use the features of another one
    pairs: Pairs
    unsure: frozenset[tuple[str, str]]


def match_and_verify(
    matching: PairMatching,
    pairs: Pairs,
    workspace: Workspace,
    workers: Workers = Workers(),
    progress: ProgressBar = silent,
    *,
    unsure: frozenset[tuple[str, str]] = frozenset(),
) -> Geometries:
    """Match pairs of images and verify the matches, without what an interrupted build did.

    The result for a pair depends on nothing but the pair, so blocks and workers change no bit of it, except
    that networks round differently for other pairs in a batch on a GPU. Pairs without a verified match are
    omitted.

    Args:
        matching: How to match and verify.
        pairs: Pairs of images.
        workspace: Keeps the result of each block of pairs, and has those of an interrupted build.
        workers: Who does the work.
        progress: Progress callback.
        unsure: Pairs that are left out unless at least eight of their 256 largest features match [1].

    References:
        [1] Wu, Towards Linear-Time Incremental Structure from Motion, 3DV 2013 (preemptive matching).
    """
    matching = replace(matching, features=matching.features.absolute())
    found = matching.features.stat()
    stamp = found.st_size, found.st_mtime_ns
    workers = workers if matching.one_thread else Workers()

    def solve(blocks: Sequence[Pairs]) -> Generator[Arrays, None, None]:
        tasks = [
            _Block(matching=matching.of(block), stamp=stamp, pairs=block, unsure=unsure.intersection(block))
            for block in blocks
        ]
        return workers.in_order(_solve, tasks)

    try:
        blocks = workspace.in_blocks(pairs, solve, progress, "match pairs")
        return {pair: one for block in blocks for pair, one in _unpacked(*block)}
    finally:
        _reader.cache_clear()


def _solve(block: _Block) -> Arrays:
    """Match and verify the pairs of a block."""
    matching = block.matching
    read = _reader(matching.features, block.stamp)
    views = lru_cache(lambda name: _view(matching, name, read(name)))
    largest = lru_cache(lambda name: _largest(read(name)))

    def may_match(a: str, b: str) -> bool:
        return (a, b) not in block.unsure or len(match_nearest(largest(a), largest(b))) >= _ALIKE

    def verified(a: str, b: str, matches: IndexPairs | None) -> pycolmap.TwoViewGeometry:
        if matches is None:
            return pycolmap.TwoViewGeometry()
        return verify(views(a), views(b), matches, seed=matching.seed)

    with threadpool_limits(1) if matching.one_thread else nullcontext():
        likely = [(a, b) for a, b in block.pairs if may_match(a, b)]
        found = match_many(matching.matcher, [(read(a), read(b)) for a, b in likely])
        matches = dict(zip(likely, found, strict=True))
        return _packed([verified(a, b, matches.get((a, b))) for a, b in block.pairs])


def _largest(features: Features) -> Descriptors:
    """Unit descriptors of the largest features, or the strongest if sizes are unknown.

    Few of them show in many images: what is large in the image is seen from far and near.
    """
    sizes = features.scores if features.frames is None else features.frames[:, 0]
    return unit_rows(features.descriptors[np.argsort(-sizes, kind="stable")[:_LARGEST]])


@lru_cache(maxsize=1)
def _reader(path: Path, stamp: tuple[int, int]) -> Callable[[str], Features]:  # noqa: ARG001
    return lru_cache(_CACHED)(FeatureFile(path).__getitem__)


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """What the verification needs of an image."""

    keypoints: Points2D
    """In pixels of the shrunk image."""

    camera: pycolmap.Camera
    """Camera of the shrunk image."""


def _view(matching: PairMatching, name: str, features: Features) -> View:
    turned = turned_features(features, matching.turns.get(name, 0))
    keypoints = off_grid(shrunk_features(turned, matching.factors[name]).keypoints)
    return View(keypoints=keypoints.astype(np.float64), camera=matching.cameras[name])


def verify(a: View, b: View, matches: IndexPairs, *, seed: int) -> pycolmap.TwoViewGeometry:
    """Estimate the two-view geometry of two images, whose inliers are the verified matches.

    The random numbers depend on the seed alone, not on the pairs before. Most pairs of images show different
    things and have a few wrong matches. RANSAC would search them for the smallest share of inliers that its
    options allow, although a pair with fewer than 15 inliers is not taken: it is told the larger share.
    """
    options = pycolmap.TwoViewGeometryOptions()
    ransac, fewest = options.ransac, options.min_num_inliers
    if len(matches) < fewest:
        return pycolmap.TwoViewGeometry()
    ransac.random_seed = seed
    ransac.min_inlier_ratio = max(ransac.min_inlier_ratio, fewest / len(matches))
    ransac.dyn_num_trials_multiplier = 1.0  # as many trials as the confidence needs, not three times as many
    return pycolmap.estimate_two_view_geometry(
        a.camera, a.keypoints, b.camera, b.keypoints, matches.astype(np.uint32), options
    )


def verify_matches(
    features: Mapping[str, Features],
    cameras: Mapping[str, pycolmap.Camera],
    matches: Mapping[tuple[str, str], IndexPairs],
    *,
    seed: int,
    progress: ProgressBar = silent,
) -> Geometries:
    """Verify matches of pairs of images that were found before."""
    views = {
        name: View(keypoints=off_grid(features[name].keypoints).astype(np.float64), camera=cameras[name])
        for name in sorted({name for pair in matches for name in pair})
    }
    return {
        (a, b): verify(views[a], views[b], matches[a, b], seed=seed)
        for a, b in progress(sorted(matches), "verify matches")
    }


def _packed(geometries: Sequence[pycolmap.TwoViewGeometry]) -> Arrays:
    """Two-view geometries as arrays; matrices that were not estimated are NaN."""
    matrices = [[getattr(one, name) for name in _MATRICES] for one in geometries]
    unknown = np.full((3, 3), np.nan)
    return {
        "counts": np.array([len(one.inlier_matches) for one in geometries]),
        "matches": np.concatenate([np.asarray(one.inlier_matches).reshape(-1, 2) for one in geometries]),
        "configs": np.array([int(one.config) for one in geometries]),
        "matrices": np.array([[unknown if m is None else m for m in three] for three in matrices]),
    }


def _unpacked(pairs: Pairs, arrays: Arrays) -> Iterator[tuple[tuple[str, str], pycolmap.TwoViewGeometry]]:
    """The two-view geometries of pairs that have verified matches."""
    ends = np.cumsum(arrays["counts"])
    for row, (pair, end) in enumerate(zip(pairs, ends.tolist(), strict=True)):
        matches = arrays["matches"][end - arrays["counts"][row] : end]
        if len(matches):
            one = pycolmap.TwoViewGeometry()
            one.config, one.inlier_matches = int(arrays["configs"][row]), matches
            for name, matrix in zip(_MATRICES, arrays["matrices"][row], strict=True):
                if not np.isnan(matrix).any():
                    setattr(one, name, matrix)
            yield pair, one
