"""How the edges of a reference graph are found: options, the protocol of edge sources, their registry."""

import hashlib
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Int64

from slimsfm.errors import InputError
from slimsfm.mapping.map import Map
from slimsfm.pose import RansacOptions

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
    """Localizes two reference images of one map from each other. Equal pairs have equal errors."""

    def pairs(self) -> PairIndices:
        """Return the pairs to try, in lexicographic order; all other pairs have no edge."""
        ...

    def errors(self, u: int, v: int) -> PairErrors:
        """Localize two images from each other, given by their indices in the order of names."""
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
