"""Carry the reference graphs of a map over to a larger one, and compute only what new images add.

Edges between old images stay as they were computed. New images may continue tracks of points that both see,
and give them new points; but old poses, points and matches did not move, so that whether one old image
localizes another hardly changes, and computing it again would cost as much as the whole graph did.
"""

from pathlib import Path
from time import perf_counter

import numpy as np
from jaxtyping import Float64, Int64

from slimsfm.execution import OpenExecutor
from slimsfm.graph import GraphOptions, GraphRun, load_or_compute_graph
from slimsfm.graph.edge_sources import Edges, edge_source, graph_key
from slimsfm.graph.io import Checkpoint, read_kept_graph
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent

_SOURCES: tuple[Edges, ...] = ("hybrid", "localize", "matches", "tracks")


def carry_graphs(
    old: Map,
    old_folder: Path,
    new_folder: Path,
    *,
    open_executor: OpenExecutor | None = None,
    progress: ProgressBar = silent,
) -> dict[str, GraphRun]:
    """Extend the reference graphs that are kept with a map to a larger map, and keep them with that.

    Graphs are carried over that have the default options of their source; others are computed again when
    they are needed.

    Args:
        old: The map.
        old_folder: Its folder.
        new_folder: Folder of the larger map, which has all images of `old`.
        open_executor: Opens the executor for pairs with new images; None: this process.
        progress: Progress callback.

    Returns:
        The graphs by source of edges.
    """
    kept: dict[Edges, GraphRun] = {}
    for source in _SOURCES:
        options = GraphOptions(edges=source)
        path = old_folder / f"graph-{source}.npz"
        run = read_kept_graph(path, graph_key(old, options), perf_counter()) if path.is_file() else None
        if run is not None:
            kept[source] = run
    if not kept:
        return {}
    larger = read_map(new_folder)
    extended: dict[str, GraphRun] = {}
    for source, run in kept.items():
        options = GraphOptions(edges=source)
        checkpoint = new_folder / f"graph-{source}.partial"
        _keep_old_errors(old, larger, run, options, checkpoint)
        extended[source] = load_or_compute_graph(larger, new_folder, options, open_executor, progress)
    return extended


def _keep_old_errors(old: Map, larger: Map, run: GraphRun, options: GraphOptions, checkpoint: Path) -> None:
    """Write what was computed for pairs of old images as the progress of the larger graph."""
    place = {name: row for row, name in enumerate(larger.images)}
    rows = np.array([place[name] for name in old.images], np.int64)
    pairs = edge_source(old, options).pairs()
    errors = np.stack([_errors(run, pairs), _errors(run, pairs[:, ::-1])], axis=1)
    with Checkpoint(checkpoint, graph_key(larger, options)) as kept:
        kept.append(rows[pairs], errors)


def _errors(run: GraphRun, pairs: Int64[np.ndarray, "k 2"]) -> Float64[np.ndarray, " k"]:
    """Errors of the second image from the first one; infinite where there is no pose."""
    entries, count = run.graph.errors.tocoo(), len(run.graph.names)
    keys = entries.row.astype(np.int64) * count + entries.col  # ascending
    wanted = pairs @ np.array([count, 1])
    places = np.searchsorted(keys, wanted).clip(max=max(len(keys) - 1, 0))
    if not len(keys):
        return np.full(len(pairs), np.inf)
    return np.where(keys[places] == wanted, entries.data[places], np.inf)
