"""Computation of a reference graph: in blocks of pairs, in any process, resumed where it was interrupted."""

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter

import numpy as np
from jaxtyping import Float64, Int64
from threadpoolctl import threadpool_limits

from slimsfm.errors import OutputExistsError
from slimsfm.execution import OpenExecutor, run_tasks
from slimsfm.files import locked, remove
from slimsfm.graph.edge_sources import (
    EdgeSource,
    GraphOptions,
    PairIndices,
    all_pairs,
    edge_source,
    graph_key,
    resolve_edges,
)
from slimsfm.graph.io import Checkpoint, read_kept_graph, write_graph
from slimsfm.graph.reference_graph import GraphRun, ReferenceGraph
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.progress import ProgressBar, silent

_TILE = 32  # images: pairs of the same two tiles are consecutive, so their descriptors stay in the cache
_TIMED_PAIRS = 8  # localized first, in this process, to choose the size of the blocks
_SAMPLE = 200  # pairs localized to estimate the recall

Errors = Float64[np.ndarray, "k 2"]
"""Row i: error of v from u and of u from v, for the pair in row i."""


@dataclass(frozen=True, kw_only=True)
class GraphWork:
    """Where a graph is computed and how its progress is kept."""

    map_path: Path | None = None
    """The map on disk, which workers open; required with `open_executor`."""

    open_executor: OpenExecutor | None = None
    """Opens the executor for blocks of pairs; None: this process."""

    checkpoint: Path | None = None
    """File that keeps the progress; None: progress is not kept."""

    block_seconds: float = 1.0
    """Expected duration of a block: progress is reported and kept after each block."""

    min_seconds: float = 5.0
    """Expected duration from which work is given to other processes; shorter work is faster in this one."""

    def __post_init__(self) -> None:
        if self.open_executor is not None and self.map_path is None:
            raise ValueError("map_path must be given with open_executor: workers open the map by it")


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
    """Find out which reference images localize which others.

    The result does not depend on where and in which blocks the work is done, bit for bit: all pairs use equal
    seeds and one thread, because matrix products on several threads may round differently. Networks on a GPU
    are an exception: they round differently for other pairs in a batch.

    Raises:
        WorkError: A block of pairs failed repeatedly.
        MapError: The map has no features: it was made for direct matching only.
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


def load_or_compute_graph(
    map: Map,
    folder: str | Path,
    options: GraphOptions = GraphOptions(),
    open_executor: OpenExecutor | None = None,
    progress: ProgressBar = silent,
    *,
    block_seconds: float = GraphWork.block_seconds,
    min_seconds: float = GraphWork.min_seconds,
) -> GraphRun:
    """Read the reference graph of a map from a folder, or compute it and write it there.

    An interrupted computation resumes where it stopped. Nothing is kept in a folder that is not writable.

    Args:
        map: The map.
        folder: Where the graph is kept. With `open_executor` it must be the folder of the map.
        options: How edges are found.
        open_executor: Opens the executor for blocks of pairs; None: this process.
        progress: Progress callback.
        block_seconds: As in `GraphWork`.
        min_seconds: As in `GraphWork`.
    """
    start, folder = perf_counter(), Path(folder)
    key = graph_key(map, options)
    path = folder / f"graph-{resolve_edges(map, options)}.npz"
    run = read_kept_graph(path, key, start)
    if run is not None:
        return run
    work = GraphWork(
        map_path=folder,
        open_executor=open_executor,
        block_seconds=block_seconds,
        min_seconds=min_seconds,
    )
    if not os.access(folder, os.W_OK):
        return compute_graph(map, options, work, progress)
    checkpoint = path.with_suffix(".partial")
    with _claimed(checkpoint) as ours:
        if not ours:  # another process computes this graph and will keep it
            return compute_graph(map, options, work, progress)
        run = compute_graph(map, options, replace(work, checkpoint=checkpoint), progress)
        with suppress(OutputExistsError):  # another process was faster
            write_graph(path, run.graph, key=key, pairs_tried=run.pairs_tried)
        remove(checkpoint)
    return run


@contextmanager
def _claimed(checkpoint: Path) -> Iterator[bool]:
    """Whether this process alone writes the checkpoint within the context; it stays if it holds anything."""
    with suppress(OSError):  # `Checkpoint` reports it
        checkpoint.touch()
    with locked(checkpoint) as held:
        try:
            yield held is not False
        finally:
            if held and checkpoint.exists() and not checkpoint.stat().st_size:
                remove(checkpoint)


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
            _fill_in(pairs, errors, checkpoint)
        left = np.flatnonzero(np.isnan(errors[:, 0]))
        timed, left = left[:_TIMED_PAIRS], left[_TIMED_PAIRS:]
        start = perf_counter()
        keep(timed, solve(source, pairs[timed]))
        seconds_per_pair = (perf_counter() - start) / max(len(timed), 1)
        size = int(np.clip(work.block_seconds / max(seconds_per_pair, 1e-6), 1, 10_000))
        blocks = [left[first : first + size] for first in range(0, len(left), size)]
        path = (work.map_path or Path()).absolute()
        tasks = [_Block(map_path=path, options=options, key=key, pairs=pairs[rows]) for rows in blocks]
        open_executor = work.open_executor if seconds_per_pair * len(left) > work.min_seconds else None
        function = _solve_block if open_executor else lambda block: solve(source, block.pairs)
        with closing(run_tasks(function, tasks, open_executor)) as done:
            for _ in progress(blocks, f"localize {len(left)} pairs from each other, {size} at a time"):
                number, found = next(done)
                keep(blocks[number], found)
    return errors


def solve(source: EdgeSource, pairs: PairIndices) -> Errors:
    """Localize pairs of images from each other, on one thread."""
    with threadpool_limits(1):
        found = source.errors(pairs)
    return np.array([(one.v_from_u, one.u_from_v) for one in found], np.float64).reshape(-1, 2)


def _solve_block(block: _Block) -> Errors:
    return solve(_open(block.map_path, block.options, block.key), block.pairs)


@lru_cache(maxsize=1)
def _open(map_path: Path, options: GraphOptions, key: str) -> EdgeSource:  # noqa: ARG001
    """Open the map once per worker, and again when another map has replaced it: its key differs."""
    return edge_source(read_map(map_path), options)


def _fill_in(pairs: PairIndices, errors: Errors, checkpoint: Checkpoint) -> None:
    """Fill in the errors that an earlier run computed."""
    rows = {(int(u), int(v)): row for row, (u, v) in enumerate(pairs)}
    for (u, v), found in zip(checkpoint.pairs.tolist(), checkpoint.errors, strict=True):
        if (u, v) in rows:
            errors[rows[u, v]] = found


def _assemble(names: tuple[str, ...], pairs: PairIndices, errors: Errors) -> ReferenceGraph:
    both_ways = np.concatenate([pairs, pairs[:, ::-1]])
    return ReferenceGraph.from_errors(names, both_ways, np.concatenate([errors[:, 0], errors[:, 1]]))


def estimate_recall(
    map: Map, run: GraphRun, options: GraphOptions, *, sample: int = _SAMPLE, seed: int = 0
) -> float:
    """Estimate the share of all edges that lies on the pairs that were tried.

    A sample of the other pairs is localized, and its share of edges is taken as theirs.

    Args:
        map: The map.
        run: Its reference graph.
        options: The options of that graph.
        sample: Largest number of pairs that are localized.
        seed: Seed of the sample.

    Returns:
        The share; 1 where all pairs were tried.
    """
    everything = replace(options, edges="localize", candidates="all")
    skipped = _difference(all_pairs(map), edge_source(map, options).pairs(), len(map.images))
    if len(skipped) == 0:
        return 1.0
    chosen = np.random.default_rng(seed).permutation(len(skipped))[:sample]
    errors = solve(edge_source(map, everything), skipped[np.sort(chosen)])
    missed = float((errors < options.threshold).sum(axis=1).mean()) * len(skipped)
    kept = run.graph.num_edges(options.threshold)
    return kept / (kept + missed) if kept + missed else 1.0


def _difference(pairs: PairIndices, taken: Int64[np.ndarray, "t 2"], count: int) -> Int64[np.ndarray, "_ 2"]:
    return pairs[~np.isin(pairs @ [count, 1], taken @ [count, 1])]
