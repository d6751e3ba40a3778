"""Reference graphs on disk, kept in the map that they are of, or given by another system."""

import csv
import os
import zlib
from pathlib import Path
from time import perf_counter
from zipfile import BadZipFile

import numpy as np
from scipy.sparse import csr_array

from slimsfm.errors import InputError
from slimsfm.execution import OpenExecutor
from slimsfm.files import remove, replacing
from slimsfm.graph.compute import GraphRun, GraphWork, compute_graph
from slimsfm.graph.key import graph_key
from slimsfm.graph.reference_graph import ReferenceGraph
from slimsfm.graph.source import GraphOptions, resolve
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent

_UNREADABLE = (OSError, ValueError, KeyError, TypeError, EOFError, RuntimeError, BadZipFile, zlib.error)


def load_or_compute_graph(
    map: Map,
    folder: Path,
    options: GraphOptions = GraphOptions(),
    open_executor: OpenExecutor | None = None,
    progress: ProgressBar = silent,
) -> GraphRun:
    """The reference graph of a map, kept in a folder, which with `open_executor` is the map's own.

    Read from the folder if it is there and fits, else computed and written there; a computation that was cut
    off goes on where it stopped. A folder that cannot be written to keeps nothing.
    """
    start = perf_counter()
    key = graph_key(map, options)
    path = folder / f"graph-{resolve(map, options)}.npz"
    run = _read_kept(path, key, start)
    if run is None and not os.access(folder, os.W_OK):
        return compute_graph(map, options, GraphWork(map_path=folder, open_executor=open_executor), progress)
    if run is None:
        checkpoint = path.with_suffix(".partial")
        work = GraphWork(map_path=folder, open_executor=open_executor, checkpoint=checkpoint)
        run = compute_graph(map, options, work, progress)
        write_graph(path, run.graph, key=key, pairs_tried=run.pairs_tried)
        remove(checkpoint)
    return run


def write_graph(path: Path, graph: ReferenceGraph, *, key: str = "", pairs_tried: int = 0) -> None:
    """Write a graph as npz (names, the errors in CSR form, the key), replacing what stood there."""
    errors = graph.errors
    with replacing(path, overwrite=True) as partial, partial.open("wb") as file:
        np.savez(
            file,
            names=np.array(graph.names),
            data=errors.data,
            indices=errors.indices,
            indptr=errors.indptr,
            key=np.array(key),
            pairs_tried=np.array(pairs_tried),
        )


def _read_kept(path: Path, key: str, start: float) -> GraphRun | None:
    """A graph that was kept; None where there is none, or one of another map or other options."""
    try:
        with path.open("rb") as file, np.load(file) as stored:
            if str(stored["key"]) != key:
                return None
            return GraphRun(
                graph=_from_npz(stored),
                pairs_tried=int(stored["pairs_tried"]),
                seconds={"read": perf_counter() - start},
            )
    except _UNREADABLE:
        return None  # computed again and replaced


def _from_npz(stored: np.lib.npyio.NpzFile) -> ReferenceGraph:
    names = tuple(stored["names"].tolist())
    shape = (len(names), len(names))
    errors = csr_array((stored["data"], stored["indices"], stored["indptr"]), shape=shape)
    errors.check_format()
    entries = errors.tocoo()
    pairs = np.stack([entries.row, entries.col], axis=1).astype(np.int64)
    return ReferenceGraph.from_errors(names, pairs, entries.data.astype(np.float64))


def read_given_graph(path: Path, map: Map) -> ReferenceGraph:
    """Read errors that another system computed.

    Either a CSV file with the header `reference,query,error`, a row a pair of image names with the relative
    corner error of the query's pose estimated from the reference alone (a pair without a row has no pose),
    or an npz file as `slimsfm graph -o` writes it.

    Raises:
        InputError: The file is missing or damaged, or names images that the map does not have.
    """
    if path.suffix == ".csv":
        return _read_csv(path, map)
    try:
        with path.open("rb") as file, np.load(file) as stored:
            graph = _from_npz(stored)
    except _UNREADABLE as error:
        raise InputError(f"{path}: not a readable graph, neither .csv nor .npz ({error})") from error
    if graph.names != tuple(map.images):
        raise InputError(f"{path}: the graph is of other images than the map")
    return graph


def _read_csv(path: Path, map: Map) -> ReferenceGraph:
    index = {name: number for number, name in enumerate(map.images)}
    pairs, errors = [], []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file)
            if not {"reference", "query", "error"} <= set(rows.fieldnames or ()):
                raise InputError(f"{path}: has not the columns reference, query, error")
            for row in rows:
                pairs.append((index[row["reference"]], index[row["query"]]))
                errors.append(float(row["error"]))
        return ReferenceGraph.from_errors(
            tuple(map.images), np.array(pairs, np.int64).reshape(-1, 2), np.array(errors, np.float64)
        )
    except KeyError as error:
        raise InputError(f"{path}: {error} is no image of the map") from error
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise InputError(f"{path}: not a readable table of errors ({error})") from error
