"""What a reference graph depends on, as one string."""

import hashlib
from dataclasses import replace

from slimsfm.graph.source import GraphOptions, resolve
from slimsfm.mapping.map import Map


def graph_key(map: Map, options: GraphOptions) -> str:
    """Equal for equal maps and options: a graph or checkpoint of another key is of other work."""
    return hashlib.sha256(f"{_relevant(map, options)} {map.fingerprint}".encode()).hexdigest()


def _relevant(map: Map, options: GraphOptions) -> GraphOptions:
    """The options with the defaults for what the chosen source does not look at."""
    edges, default = resolve(map, options), GraphOptions()
    return replace(
        options,
        edges=edges,
        threshold=options.threshold if edges == "hybrid" else default.threshold,
        candidates=options.candidates if edges == "localize" else default.candidates,
        matcher=options.matcher if edges in ("localize", "hybrid") else default.matcher,
    )
