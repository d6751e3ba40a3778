"""Reference graphs and the progress of their computation on disk.

A checkpoint is a file that stays readable when the process crashes at any moment:

    KEY (64 characters) and a newline
    u, v (two little-endian 32-bit integers), error of v from u, of u from v (two 64-bit floats); and so on

Records are only ever appended. A file with another key belongs to other work and is replaced; half a record
at the end is the result of a crash and is removed.
"""

import csv
from collections.abc import Mapping
from contextlib import suppress
from io import StringIO
from pathlib import Path
from time import perf_counter
from types import TracebackType

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_array

from slimsfm.errors import InputError, OutputError
from slimsfm.files import contents_of, read_npz, read_text, replacing
from slimsfm.graph.reference_graph import GraphRun, ReferenceGraph
from slimsfm.mapping.map import Map

_RECORD = np.dtype([("u", "<u4"), ("v", "<u4"), ("v_from_u", "<f8"), ("u_from_v", "<f8")])


class Checkpoint:
    """Keeps the errors of pairs in a file. A context manager, which closes the file and leaves it there.

    Raises:
        OutputError: The file cannot be written.
    """

    def __init__(self, path: Path, key: str) -> None:
        self._path = path
        self._header = key.encode("ascii") + b"\n"
        self.pairs, self.errors = self._resume()

    def _resume(self) -> tuple[Int64[np.ndarray, "k 2"], Float64[np.ndarray, "k 2"]]:
        data = self._path.read_bytes() if self._path.exists() else b""
        if not data.startswith(self._header):
            data = self._begin()
        count = (len(data) - len(self._header)) // _RECORD.itemsize
        records = np.frombuffer(data, _RECORD, count, len(self._header))
        self._file = self._path.open("r+b")
        self._file.seek(len(self._header) + count * _RECORD.itemsize)
        self._file.truncate()
        pairs = np.stack([records["u"], records["v"]], axis=1).astype(np.int64)
        return pairs, np.stack([records["v_from_u"], records["u_from_v"]], axis=1)

    def _begin(self) -> bytes:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.write_bytes(self._header)
        except OSError as error:
            with suppress(OSError):
                self._path.unlink()
            raise self._failure(error) from error
        return self._header

    def _failure(self, error: OSError) -> OutputError:
        return OutputError(f"{self._path}: cannot be written ({error.strerror or error})")

    def __enter__(self) -> "Checkpoint":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # `append` has already raised it
            self._file.close()

    def append(self, pairs: Int64[np.ndarray, "k 2"], errors: Float64[np.ndarray, "k 2"]) -> None:
        """Append the errors of some pairs.

        Raises:
            OutputError: The file cannot be written.
        """
        records = np.empty(len(pairs), _RECORD)
        records["u"], records["v"] = pairs.T
        records["v_from_u"], records["u_from_v"] = errors.T
        try:
            self._file.write(records.tobytes())
            self._file.flush()
        except OSError as error:
            raise self._failure(error) from error


def write_graph(path: str | Path, graph: ReferenceGraph, *, key: str = "", pairs_tried: int = 0) -> None:
    """Write a graph as npz (names, errors in CSR form, key), replacing an existing file."""
    errors = graph.errors
    with replacing(Path(path), overwrite=True) as partial, partial.open("wb") as file:
        np.savez(
            file,
            names=np.array(graph.names),
            data=errors.data,
            indices=errors.indices,
            indptr=errors.indptr,
            key=np.array(key),
            pairs_tried=np.array(pairs_tried),
        )


def read_kept_graph(path: Path, key: str, start: float) -> GraphRun | None:
    """Read a graph that was kept by `write_graph`; None if it is missing, damaged or has another key.

    Args:
        path: The npz file.
        key: The expected `graph_key`.
        start: When the caller started, by `perf_counter`: the time until now is reported as that of reading.
    """
    try:
        with contents_of(path, "damaged"):
            stored = read_npz(path)
            if str(stored["key"]) != key:
                return None
            return GraphRun(
                graph=_from_npz(stored),
                pairs_tried=int(stored["pairs_tried"]),
                seconds={"read": perf_counter() - start},
            )
    except InputError:
        return None


def _from_npz(stored: Mapping[str, np.ndarray]) -> ReferenceGraph:
    names = tuple(stored["names"].tolist())
    shape = (len(names), len(names))
    errors = csr_array((stored["data"], stored["indices"], stored["indptr"]), shape=shape)
    errors.check_format()
    entries = errors.tocoo()
    pairs = np.stack([entries.row, entries.col], axis=1).astype(np.int64)
    return ReferenceGraph.from_errors(names, pairs, entries.data.astype(np.float64))


def read_given_graph(path: str | Path, map: Map) -> ReferenceGraph:
    """Read errors that another system computed.

    Args:
        path: Either a CSV file with the header `reference,query,error` and one row per pair of image names
            with the relative corner error of the query's pose, estimated from the reference alone (a pair
            without a row has no pose); or an npz file written by `write_graph`.
        map: The map that the graph belongs to.

    Raises:
        InputError: The file is missing or damaged, or names images that the map does not have.
    """
    path = Path(path)
    if path.suffix == ".csv":
        return _read_csv(path, map)
    with contents_of(path, "not a readable graph, neither .csv nor .npz"):
        graph = _from_npz(read_npz(path))
    if graph.names != tuple(map.images):
        raise InputError(f"{path}: the images of the graph are not those of the map")
    return graph


def _read_csv(path: Path, map: Map) -> ReferenceGraph:
    index = {name: number for number, name in enumerate(map.images)}
    pairs, errors = [], []
    with contents_of(path, "not a readable table of errors"):
        rows = csv.DictReader(StringIO(read_text(path), newline=""))
        if not {"reference", "query", "error"} <= set(rows.fieldnames or ()):
            raise InputError(f"{path}: lacks one of the columns reference, query, error")
        for row in rows:
            if unknown := {row["reference"], row["query"]} - index.keys():
                raise InputError(f"{path}: {unknown.pop()!r} is not an image of the map")
            pairs.append((index[row["reference"]], index[row["query"]]))
            errors.append(float(row["error"]))
        return ReferenceGraph.from_errors(
            tuple(map.images), np.array(pairs, np.int64).reshape(-1, 2), np.array(errors, np.float64)
        )
