"""Options of the reference graph, pairs of images worth trying, and the sources of edges.

References:
    [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set, 2025.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from importlib import import_module
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int64
from scipy.sparse import triu

from slimsfm.arrays import Ids, Points2D
from slimsfm.errors import InputError
from slimsfm.features import unit_rows
from slimsfm.geometry import corner_error, project, resized_camera
from slimsfm.localization.matching import matching_with
from slimsfm.localization.strategy import MatchingOptions, Query
from slimsfm.mapping.map import Map, observed
from slimsfm.pose import RansacOptions, estimate_pose

Edges = Literal["auto", "matches", "tracks", "localize", "hybrid"]

PairIndices = Int64[np.ndarray, "k 2"]
"""Rows (u, v), u < v: indices of two reference images in the order of their names."""


@dataclass(frozen=True, kw_only=True)
class GraphOptions:
    """How to decide whether one reference image localizes another."""

    edges: Edges = "auto"
    """matches: use the verified matches in the map. tracks: use only the points that both images see.
    localize: match each image against each other image again (the paper's Algorithm 1). hybrid: use the
    matches, and localize where they do not decide. auto: matches, or tracks if the map has no matches."""

    candidates: Literal["likely", "all"] = "likely"
    """Pairs that `localize` tries. likely: pairs that see a common point, or overlapping parts of the box
    from similar directions. all: every pair."""

    threshold: float = 0.05
    """Relative corner error below which an image counts as localized; `hybrid` localizes pairs near it."""

    matcher: str = "auto"
    """Matcher for pairs that are matched again. auto: nearest neighbors, or the map's own matcher if it was
    built without a detector."""

    ransac: RansacOptions = RansacOptions()
    """The robust pose search."""

    def __post_init__(self) -> None:
        if self.edges not in get_args(Edges):
            raise ValueError(f"edges must be one of {', '.join(get_args(Edges))}, got {self.edges!r}")
        if not self.threshold > 0:
            raise ValueError(f"threshold must be positive, got {self.threshold}")


@dataclass(frozen=True, kw_only=True)
class PairErrors:
    """Relative corner errors of images u and v localized from each other; infinite without a pose."""

    v_from_u: float
    """Error of v's pose, estimated from u alone."""

    u_from_v: float
    """Error of u's pose, estimated from v alone."""


@runtime_checkable
class EdgeSource(Protocol):
    """Localizes reference images of one map from each other, two by two. Equal pairs have equal errors."""

    def pairs(self) -> PairIndices:
        """Return the pairs to try, in lexicographic order; all other pairs have no edge."""
        ...

    def errors(self, pairs: PairIndices) -> list[PairErrors]:
        """Localize the images of each pair from each other; u may be greater than v."""
        ...


# Paths, not classes: naming a source must not import what it needs.
EDGE_SOURCES = {
    "hybrid": "slimsfm.graph.edge_sources:HybridEdges",
    "localize": "slimsfm.graph.edge_sources:LocalizeEdges",
    "matches": "slimsfm.graph.edge_sources:MatchEdges",
    "tracks": "slimsfm.graph.edge_sources:TrackEdges",
}


def edge_source(map: Map, options: GraphOptions) -> EdgeSource:
    """Create the edge source that the options select."""
    module, attribute = EDGE_SOURCES[resolve_edges(map, options)].split(":")
    return getattr(import_module(module), attribute)(map, options)


def resolve_edges(map: Map, options: GraphOptions) -> str:
    """Return the name of the edge source that the options select; "auto" depends on the map.

    Raises:
        InputError: `options.edges` is "matches" and the map has no matches.
    """
    if options.edges == "matches" and not map.matches:
        raise InputError("the map has no matches; use `edges='tracks'` or `edges='localize'`")
    if options.edges != "auto":
        return options.edges
    return "matches" if map.matches else "tracks"


def graph_key(map: Map, options: GraphOptions) -> str:
    """Hash everything that a reference graph depends on: graphs and checkpoints of equal work share a key."""
    return hashlib.sha256(f"{_relevant(map, options)} {map.fingerprint}".encode()).hexdigest()


def _relevant(map: Map, options: GraphOptions) -> GraphOptions:
    """The options, with defaults for those that the selected source ignores."""
    edges, default = resolve_edges(map, options), GraphOptions()
    return replace(
        options,
        edges=edges,
        threshold=options.threshold if edges == "hybrid" else default.threshold,
        candidates=options.candidates if edges == "localize" else default.candidates,
        matcher=options.matcher if edges in ("localize", "hybrid") else default.matcher,
    )


_GRID = 5  # samples along each edge of the box
_MAX_ANGLE_DEG = 75.0  # between viewing directions: no built-in extractor matches across more
_BLOCK = 1024  # images compared at once


def covisible_pairs(map: Map, min_points: int = 1) -> Int64[np.ndarray, "k 2"]:
    """Pairs (u, v), u < v, that see at least `min_points` common points; O(sum of squared track lengths)."""
    incidence = observed(map).astype(np.int32)
    common = triu(incidence @ incidence.T, k=1).tocoo()
    enough = common.data >= min_points
    return _sorted(np.stack([common.row[enough], common.col[enough]], axis=1).astype(np.int64))


def likely_pairs(map: Map) -> Int64[np.ndarray, "k 2"]:
    """Pairs that see a common point, or overlapping parts of the box from directions within 75 degrees.

    The box is sampled on a 5 x 5 x 5 grid. The direction of an image points from its camera to the mean of
    the samples it sees.
    """
    visible, directions = _views(map)
    least_cosine = np.cos(np.radians(_MAX_ANGLE_DEG))
    found = [covisible_pairs(map)]
    for start in range(0, len(visible), _BLOCK):
        block = slice(start, start + _BLOCK)
        meet = (visible[block] @ visible.T > 0) & (directions[block] @ directions.T >= least_cosine)
        rows, columns = np.nonzero(meet)
        found.append(np.stack([rows + start, columns], axis=1)[columns > rows + start])
    return _sorted(np.concatenate(found))


def all_pairs(map: Map) -> Int64[np.ndarray, "k 2"]:
    """All pairs (u, v), u < v."""
    return np.stack(np.triu_indices(len(map.images), k=1), axis=1).astype(np.int64)


def _views(map: Map) -> tuple[Float32[np.ndarray, "n s"], Float32[np.ndarray, "n 3"]]:
    """Which samples of the box each image sees, as 0 and 1, and its direction toward them (0 if none)."""
    steps = np.linspace(-1, 1, _GRID)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    samples = map.box.center + grid @ map.box.half_edges
    visible = np.array([_inside(map, name, samples) for name in map.images])
    directions = np.zeros((len(visible), 3), np.float32)
    for row, image in enumerate(map.images.values()):
        if visible[row].any():
            towards = samples[visible[row]].mean(axis=0) - image.projection_center()
            directions[row] = towards / max(float(np.linalg.norm(towards)), 1e-12)
    return visible.astype(np.float32), directions


def _inside(map: Map, name: str, samples: np.ndarray) -> Bool[np.ndarray, " s"]:
    camera = map.camera(name)
    pixels = project(samples, map.images[name].cam_from_world(), camera)
    return np.all((pixels >= 0) & (pixels <= [camera.width, camera.height]), axis=1)


def _sorted(pairs: Int64[np.ndarray, "k 2"]) -> Int64[np.ndarray, "_ 2"]:
    return np.unique(pairs, axis=0)


_CACHED_IMAGES = 256
_CACHED_QUERIES = 64  # 2 MB each with 4096 descriptors of 128 numbers
_TOGETHER = 64  # queries and references that are matched in one call
_MOST_MATCHES = 100  # per pose: stored matches are verified, so more of them hardly change it
_NEAR = 2.0  # an error within this factor of the threshold may fall on either side of it
_MIN_COMMON_POINTS = 20  # a pair without stored matches is worth matching from here


class PosedReferences:
    """The reference images of a map by index, and the step that all sources share: pose and error."""

    def __init__(self, map: Map, ransac: RansacOptions) -> None:
        self.map = map
        self.names = tuple(map.images)
        self._ransac = ransac

    @cached_property
    def index(self) -> dict[str, int]:
        """Index of each name."""
        return {name: index for index, name in enumerate(self.names)}

    def points_of(self, index: int) -> Int64[np.ndarray, " n"]:
        """For each keypoint of an image the row of the point that it observes, or -1."""
        name = self.names[index]
        points = np.full(self.map.images[name].num_points2D(), -1, np.int64)
        seen = self.map.observations[name]
        points[seen.rows] = seen.points
        return points

    def error(self, index: int, points2D: Points2D, points: Ids) -> float:
        """Relative corner error of an image's pose, estimated from pixels and the rows of their points."""
        name = self.names[index]
        camera, factor = self.map.camera(name), self.map.shrink_factor(name)
        if factor > 1:
            points2D, camera = points2D / factor, resized_camera(camera, 1 / factor)
        pose = estimate_pose(points2D, self.map.points3D_in_world[points], camera, self._ransac)
        if pose is None:
            return np.inf
        return corner_error(pose.cam_from_world, self.map.images[name].cam_from_world(), self.map.box)


class MatchEdges:
    """Localizes images from each other by the verified matches in the map.

    A match between a keypoint of u that observes a point and a keypoint of v is a 2D-3D match of v. Each pair
    is read once for both directions. A pair without stored matches has no edge. Cost: one pose per direction,
    no matching.
    """

    def __init__(self, map: Map, options: GraphOptions) -> None:
        self._references = PosedReferences(map, options.ransac)
        self._points = lru_cache(_CACHED_IMAGES)(self._references.points_of)

    def pairs(self) -> PairIndices:
        """Return the pairs that have stored matches."""
        index = self._references.index
        found = [(index[a], index[b]) for a, b in self._references.map.matches if a in index and b in index]
        pairs = np.array(found, np.int64).reshape(-1, 2)
        return np.unique(np.sort(pairs, axis=1), axis=0)

    def errors(self, pairs: PairIndices) -> list[PairErrors]:
        """Localize the images of each pair from each other."""
        return [self._errors(u, v) for u, v in pairs.tolist()]

    def _errors(self, u: int, v: int) -> PairErrors:
        rows_u, rows_v = self._matches(u, v).T
        return PairErrors(
            v_from_u=self._error(u, rows_u, v, rows_v), u_from_v=self._error(v, rows_v, u, rows_u)
        )

    def _error(self, reference: int, reference_rows: np.ndarray, query: int, query_rows: np.ndarray) -> float:
        points = self._points(reference)[reference_rows]
        sees = np.flatnonzero(points >= 0)
        used = sees[:: max(1, -(-len(sees) // _MOST_MATCHES))]
        return self._references.error(query, self._pixels(query, query_rows[used]), points[used])

    def _matches(self, u: int, v: int) -> Int64[np.ndarray, "n 2"]:
        matches, names = self._references.map.matches, self._references.names
        if (names[u], names[v]) in matches:
            return matches[names[u], names[v]]
        return matches[names[v], names[u]][:, ::-1]

    def _pixels(self, index: int, rows: Ids) -> Points2D:
        points2D = self._references.map.images[self._references.names[index]].points2D
        return np.array([points2D[row].xy for row in rows.tolist()], np.float64).reshape(-1, 2)


class TrackEdges:
    """Localizes images from each other by the points that both see, for maps without matches.

    A point that u and v both see is a 2D-3D match in either direction. A track joins more keypoints than any
    single pair of images matches, so this source finds too many edges rather than too few.
    """

    def __init__(self, map: Map, options: GraphOptions) -> None:
        self._references = PosedReferences(map, options.ransac)
        self._min_points = options.ransac.min_inliers
        self._seen = lru_cache(_CACHED_IMAGES)(self._seen_by)

    def pairs(self) -> PairIndices:
        """Return the pairs that see enough common points for a pose."""
        return covisible_pairs(self._references.map, self._min_points)

    def errors(self, pairs: PairIndices) -> list[PairErrors]:
        """Localize the images of each pair from each other."""
        return [self._errors(u, v) for u, v in pairs.tolist()]

    def _errors(self, u: int, v: int) -> PairErrors:
        points_u, pixels_u = self._seen(u)
        points_v, pixels_v = self._seen(v)
        common, rows_u, rows_v = np.intersect1d(points_u, points_v, return_indices=True)
        return PairErrors(
            v_from_u=self._references.error(v, pixels_v[rows_v], common),
            u_from_v=self._references.error(u, pixels_u[rows_u], common),
        )

    def _seen_by(self, index: int) -> tuple[Ids, Points2D]:
        name = self._references.names[index]
        points2D, seen = self._references.map.images[name].points2D, self._references.map.observations[name]
        pixels = np.array([points2D[row].xy for row in seen.rows], np.float64).reshape(-1, 2)
        return seen.points, pixels


class LocalizeEdges:
    """Localizes images from each other by matching them again: Algorithm 1 of the paper [1].

    To localize v from u, the keypoints of v are matched against the points that u sees, each described as in
    u. Complexity: two matchings per pair, each of all keypoints of one image with the points of the other.
    """

    def __init__(self, map: Map, options: GraphOptions) -> None:
        self._references = PosedReferences(map, options.ransac)
        self._options = options
        self._matching = matching_with(map, MatchingOptions(matcher=options.matcher), _CACHED_QUERIES)
        self._query = lru_cache(_CACHED_QUERIES)(self._read)

    def pairs(self) -> PairIndices:
        """Return the likely pairs, or all pairs."""
        choose = all_pairs if self._options.candidates == "all" else likely_pairs
        return choose(self._references.map)

    def errors(self, pairs: PairIndices) -> list[PairErrors]:
        """Localize the images of each pair from each other."""
        found = self.errors_of(_both_ways(pairs))
        return [PairErrors(v_from_u=a, u_from_v=b) for a, b in zip(found[::2], found[1::2], strict=True)]

    def errors_of(self, directed: Sequence[tuple[int, int]]) -> list[float]:
        """Relative corner error of the query's pose, estimated from the reference alone.

        Args:
            directed: Indices of a reference and a query each.
        """
        found: list[float] = []
        for start in range(0, len(directed), _TOGETHER):
            some = directed[start : start + _TOGETHER]
            seen = [(self._query(query), reference) for reference, query in some]
            found += [
                self._references.error(index, matches.pixels(query), matches.points)
                for (_, index), (query, _), matches in zip(
                    some, seen, self._matching.match(seen, None), strict=True
                )
            ]
        return found

    def _read(self, index: int) -> Query:
        map_, name = self._references.map, self._references.names[index]
        features = map_.features[name]
        return Query(
            keypoints=features.keypoints.astype(np.float64),
            descriptors=unit_rows(features.descriptors),
            features=features,
            camera=map_.camera(name),
            image=map_.photos.get(name),
            shrink_factor=map_.shrink_factor(name),
        )


def _both_ways(pairs: PairIndices) -> list[tuple[int, int]]:
    """A reference and a query for each pair and direction: v from u, then u from v."""
    return [one for u, v in pairs.tolist() for one in ((u, v), (v, u))]


class HybridEdges:
    """Uses stored matches, and localizes only where they do not decide.

    Stored matches do not decide where a pair has no matches although its images see enough common points,
    where fewer matches become 2D-3D matches than a pose needs, where they give no pose, and where an error is
    near the threshold.
    """

    def __init__(self, map: Map, options: GraphOptions) -> None:
        self._map = map
        self._options = options
        self._matches = MatchEdges(map, options)
        self._localize = LocalizeEdges(map, options)
        self._matched = {(int(u), int(v)) for u, v in self._matches.pairs()}

    def pairs(self) -> PairIndices:
        """Return the pairs that have stored matches or see enough common points."""
        covisible = covisible_pairs(self._map, _MIN_COMMON_POINTS)
        return np.unique(np.concatenate([self._matches.pairs(), covisible]), axis=0)

    def errors(self, pairs: PairIndices) -> list[PairErrors]:
        """Localize the images of each pair from each other."""
        matched = [(u, v) for u, v in pairs.tolist() if (min(u, v), max(u, v)) in self._matched]
        by_matches = self._matches.errors(np.array(matched, np.int64).reshape(-1, 2))
        known: dict[tuple[int, int], float] = {}  # by reference and query
        for (u, v), one in zip(matched, by_matches, strict=True):
            known[u, v], known[v, u] = one.v_from_u, one.u_from_v
        left = [one for one in _both_ways(pairs) if one not in known or not self._is_decided(known[one])]
        known |= dict(zip(left, self._localize.errors_of(left), strict=True))
        return [PairErrors(v_from_u=known[u, v], u_from_v=known[v, u]) for u, v in pairs.tolist()]

    def _is_decided(self, error: float) -> bool:
        threshold = self._options.threshold
        return error < threshold / _NEAR or threshold * _NEAR < error < np.inf
