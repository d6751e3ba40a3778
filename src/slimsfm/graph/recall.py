"""What pruning candidate pairs costs: the share of edges that it keeps."""

from dataclasses import replace

import numpy as np
from jaxtyping import Int64

from slimsfm.graph.candidates import all_pairs
from slimsfm.graph.compute import GraphRun, solve
from slimsfm.graph.source import GraphOptions, PairIndices, edge_source
from slimsfm.mapping.map import Map

_SAMPLE = 200


def estimate_recall(map: Map, run: GraphRun, options: GraphOptions, *, seed: int = 0) -> float:
    """Estimate which share of the edges lies on the pairs that were tried.

    A sample of the other pairs is localized and its share of edges taken for theirs. 1 where all pairs
    were tried. Costs at most 200 pairs.
    """
    everything = replace(options, edges="localize", candidates="all")
    tried = edge_source(map, options).pairs()
    skipped = _difference(all_pairs(map), tried, len(map.images))
    if len(skipped) == 0:
        return 1.0
    chosen = np.random.default_rng(seed).permutation(len(skipped))[:_SAMPLE]
    errors = solve(edge_source(map, everything), skipped[np.sort(chosen)])
    missed = float((errors < options.threshold).sum(axis=1).mean()) * len(skipped)
    kept = run.graph.num_edges(options.threshold)
    return kept / (kept + missed) if kept + missed else 1.0


def _difference(pairs: PairIndices, taken: Int64[np.ndarray, "t 2"], count: int) -> Int64[np.ndarray, "_ 2"]:
    return pairs[~np.isin(pairs @ [count, 1], taken @ [count, 1])]
