"""Computing a reference graph: in blocks of pairs, here or elsewhere, and onwards from where it stopped."""

from contextlib import closing, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from time import perf_counter

import numpy as np
from jaxtyping import Float64
from threadpoolctl import threadpool_limits

from slimsfm.execution import OpenExecutor, run_tasks
from slimsfm.graph.checkpoint import Checkpoint
from slimsfm.graph.key import graph_key
from slimsfm.graph.reference_graph import ReferenceGraph
from slimsfm.graph.source import EdgeSource, GraphOptions, PairIndices, edge_source
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.progress import ProgressBar, silent

_TILE = 32  # images; pairs of two tiles follow each other, so that their descriptors stay in the cache
_TRIAL = 8  # pairs that are timed to size the blocks
_BLOCK_SECONDS = 1.0
_WORTH_SECONDS = 5.0  # less work than this is done before another process has started

Errors = Float64[np.ndarray, "k 2"]
"""Row i: error of v from u and of u from v, for the pair in row i."""


@dataclass(frozen=True, kw_only=True)
class GraphWork:
    """Where a graph is computed and how its progress is kept."""

    map_path: Path | None = None
    """The map on disk, which workers open for themselves; needed with `open_executor`."""

    open_executor: OpenExecutor | None = None
    """Where blocks of pairs are worked on; None: here."""

    checkpoint: Path | None = None
    """File that keeps the progress; None: none is kept."""

    def __post_init__(self) -> None:
        if self.open_executor is not None and self.map_path is None:
            raise ValueError("map_path must be given with open_executor: workers open the map by it")


@dataclass(frozen=True, kw_only=True, eq=False)
class GraphRun:
    """A reference graph and what it took."""

    graph: ReferenceGraph
    """The graph."""

    pairs_tried: int
    """Unordered pairs of images that were localized from each other, both ways."""

    seconds: dict[str, float]
    """Time of each stage."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Block:
    map_path: Path
    options: GraphOptions
    key: str
    pairs: PairIndices


def compute_graph(
    map: Map,
    options: GraphOptions = GraphOptions(),
    work: GraphWork = GraphWork(),
    progress: ProgressBar = silent,
) -> GraphRun:
    """Find out which reference image localizes which other one.

    The result does not depend on where and in which blocks the work is done, bit by bit: every pair is
    localized with equal seeds, and on one thread, for a matrix product on several may round otherwise.

    Raises:
        WorkError: A block of pairs failed again and again.
        MapError: The map was made for direct matching alone.
    """
    check_has_features(map)
    start = perf_counter()
    source = edge_source(map, options)
    pairs = _in_tiles(source.pairs())
    chosen = perf_counter()
    key = graph_key(map, options) if work.checkpoint or work.open_executor else ""
    errors = _solve_all(source, pairs, options, work, key, progress)
    solved = perf_counter()
    graph = _assemble(tuple(map.images), pairs, errors)
    seconds = {"candidates": chosen - start, "localize": solved - chosen, "assemble": perf_counter() - solved}
    return GraphRun(graph=graph, pairs_tried=len(pairs), seconds=seconds)


def _in_tiles(pairs: PairIndices) -> PairIndices:
    u, v = pairs.T
    return pairs[np.lexsort((v, u, v // _TILE, u // _TILE))]


def _solve_all(
    source: EdgeSource,
    pairs: PairIndices,
    options: GraphOptions,
    work: GraphWork,
    key: str,
    progress: ProgressBar,
) -> Errors:
    errors = np.full((len(pairs), 2), np.nan)
    with Checkpoint(work.checkpoint, key) if work.checkpoint else nullcontext(None) as checkpoint:

        def keep(rows: np.ndarray, found: Errors) -> None:
            errors[rows] = found
            if checkpoint:
                checkpoint.append(pairs[rows], found)

        if checkpoint:
            _recall(pairs, errors, checkpoint)
        left = np.flatnonzero(np.isnan(errors[:, 0]))
        trial, left = left[:_TRIAL], left[_TRIAL:]
        start = perf_counter()
        keep(trial, solve(source, pairs[trial]))
        each = (perf_counter() - start) / max(len(trial), 1)
        size = int(np.clip(_BLOCK_SECONDS / max(each, 1e-6), 1, 10_000))
        blocks = [left[first : first + size] for first in range(0, len(left), size)]
        path = (work.map_path or Path()).absolute()
        tasks = [_Block(map_path=path, options=options, key=key, pairs=pairs[rows]) for rows in blocks]
        open_executor = work.open_executor if each * len(left) > _WORTH_SECONDS else None
        function = _solve_block if open_executor else lambda block: solve(source, block.pairs)
        with closing(run_tasks(function, tasks, open_executor)) as done:
            for _ in progress(blocks, f"localize {len(left)} pairs from each other, {size} at a time"):
                number, found = next(done)
                keep(blocks[number], found)
    return errors


def solve(source: EdgeSource, pairs: PairIndices) -> Errors:
    """Localize pairs of images from each other."""
    with threadpool_limits(1):
        found = [source.errors(int(u), int(v)) for u, v in pairs]
    return np.array([(one.v_from_u, one.u_from_v) for one in found], np.float64).reshape(-1, 2)


def _solve_block(block: _Block) -> Errors:
    return solve(_open(block.map_path, block.options, block.key), block.pairs)


@lru_cache(maxsize=1)
def _open(map_path: Path, options: GraphOptions, key: str) -> EdgeSource:  # noqa: ARG001
    """A worker opens the map once, and anew when another one has taken its place."""
    return edge_source(read_map(map_path), options)


def _recall(pairs: PairIndices, errors: Errors, checkpoint: Checkpoint) -> None:
    """Fill in what an earlier run found."""
    rows = {(int(u), int(v)): row for row, (u, v) in enumerate(pairs)}
    for (u, v), found in zip(checkpoint.pairs.tolist(), checkpoint.errors, strict=True):
        if (u, v) in rows:
            errors[rows[u, v]] = found


def _assemble(names: tuple[str, ...], pairs: PairIndices, errors: Errors) -> ReferenceGraph:
    both_ways = np.concatenate([pairs, pairs[:, ::-1]])
    return ReferenceGraph.from_errors(names, both_ways, np.concatenate([errors[:, 0], errors[:, 1]]))
