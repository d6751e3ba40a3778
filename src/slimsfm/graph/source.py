"""What every source of edges takes and gives, and the sources there are."""

from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Int64

from slimsfm.arrays import Ids, Points2D
from slimsfm.errors import InputError
from slimsfm.geometry import corner_error
from slimsfm.mapping.map import Map
from slimsfm.pose import RansacOptions, estimate_pose

Edges = Literal["auto", "matches", "tracks", "localize", "hybrid"]

PairIndices = Int64[np.ndarray, "k 2"]
"""Rows (u, v), u < v: indices of two reference images in order of their names."""


@dataclass(frozen=True, kw_only=True)
class GraphOptions:
    """How edges are found: whether one reference image localizes another."""

    edges: Edges = "auto"
    """matches: from the verified matches that the map has. tracks: from common points alone. localize: each
    image matched anew with each other one (the paper's Algorithm 1). hybrid: localize where matches leave it
    open. auto: matches, or tracks where the map has none."""

    candidates: Literal["likely", "all"] = "likely"
    """Pairs that `localize` tries: those that see a common point, or overlapping parts of the box from
    directions not too far apart; or all."""

    threshold: float = 0.05
    """Relative corner error below which an image counts as localized; `hybrid` looks closer around it."""

    matcher: str = "auto"
    """What matches images, where they are matched anew; auto: nearest neighbours, or without a detector where
    the map was built so."""

    ransac: RansacOptions = RansacOptions()
    """The pose search."""

    def __post_init__(self) -> None:
        if self.edges not in get_args(Edges):
            raise ValueError(f"edges must be one of {', '.join(get_args(Edges))}, got {self.edges!r}")
        if not self.threshold > 0:
            raise ValueError(f"threshold must be positive, got {self.threshold}")


@dataclass(frozen=True, kw_only=True)
class PairErrors:
    """Relative corner errors of images u and v localized from each other; infinite without a pose."""

    v_from_u: float
    """Of v's pose, estimated from u alone."""

    u_from_v: float
    """Of u's pose, estimated from v alone."""


@runtime_checkable
class EdgeSource(Protocol):
    """Tells how well two reference images of one map localize each other. Equal pairs, equal errors."""

    def pairs(self) -> PairIndices:
        """The pairs worth trying, in lexicographic order; any other has no edge."""
        ...

    def errors(self, u: int, v: int) -> PairErrors:
        """Localize two images, by index in order of names, from each other."""
        ...


# Paths, not classes: naming a source must not import what it needs.
EDGE_SOURCES = {
    "hybrid": "slimsfm.graph.hybrid:HybridEdges",
    "localize": "slimsfm.graph.localize:LocalizeEdges",
    "matches": "slimsfm.graph.matches:MatchEdges",
    "tracks": "slimsfm.graph.tracks:TrackEdges",
}


def edge_source(map: Map, options: GraphOptions) -> EdgeSource:
    """Make the source that the options name."""
    module, attribute = EDGE_SOURCES[resolve(map, options)].split(":")
    return getattr(import_module(module), attribute)(map, options)


def resolve(map: Map, options: GraphOptions) -> str:
    """The source that the options name, or that "auto" stands for.

    Raises:
        InputError: The map has not what the source needs.
    """
    if options.edges == "matches" and not map.matches:
        raise InputError("the map has no matches; use `edges='tracks'` or `edges='localize'`")
    if options.edges != "auto":
        return options.edges
    return "matches" if map.matches else "tracks"


class References:
    """The reference images of a map by index, and the one step that all sources share: pose and error."""

    def __init__(self, map: Map, ransac: RansacOptions) -> None:
        self.map = map
        self.names = tuple(map.images)
        self._ransac = ransac

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def index(self) -> dict[str, int]:
        """Index of each name."""
        return {name: index for index, name in enumerate(self.names)}

    def points_of(self, index: int) -> Int64[np.ndarray, " n"]:
        """For each keypoint of an image the row of the point that it sees, or -1."""
        name = self.names[index]
        points = np.full(self.map.images[name].num_points2D(), -1, np.int64)
        seen = self.map.observations[name]
        points[seen.rows] = seen.points
        return points

    def error(self, index: int, points2D: Points2D, points: Ids) -> float:
        """Relative corner error of an image's pose from matches of its pixels with rows of points."""
        name = self.names[index]
        pose = estimate_pose(
            points2D, self.map.points3D_in_world[points], self.map.camera(name), self._ransac
        )
        if pose is None:
            return np.inf
        return corner_error(pose.cam_from_world, self.map.images[name].cam_from_world(), self.map.box)
