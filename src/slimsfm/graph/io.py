"""Reference graphs on disk, kept beside the map that they are of."""

import hashlib
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from slimsfm.files import replacing
from slimsfm.graph.localize import GraphOptions, localize_pairs
from slimsfm.graph.reference_graph import ReferenceGraph
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent


def graph_key(map: Map, options: GraphOptions) -> str:
    """Equal for equal maps and options: only where the keys are equal is a graph reused."""
    digest = hashlib.sha256(repr((options, map.info.extractor, map.info.extractor_options)).encode())
    digest.update(map.box.corners.tobytes())
    digest.update(map.point3D_ids.tobytes())
    digest.update(map.points3D_in_world.tobytes())
    for name, image in map.images.items():
        digest.update(name.encode())
        digest.update(image.cam_from_world().matrix().tobytes())
        digest.update(map.camera(name).model_name.encode() + map.camera(name).params.tobytes())
        digest.update(map.observations[name].rows.tobytes())
        digest.update(map.observations[name].points.tobytes())
    return digest.hexdigest()


def write_graph(path: Path, graph: ReferenceGraph, key: str) -> None:
    """Write a graph as npz: names, errors and the key, replacing what stood there."""
    with replacing(path, overwrite=True) as partial, partial.open("wb") as file:
        np.savez(file, names=np.array(graph.names), errors=graph.errors, key=np.array(key))


def read_graph(path: Path, key: str) -> ReferenceGraph | None:
    """Read a graph; None where there is none, or one of another map or other options."""
    try:
        with path.open("rb") as file, np.load(file) as stored:
            if str(stored["key"]) != key:
                return None
            return ReferenceGraph(names=tuple(stored["names"].tolist()), errors=stored["errors"])
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, RuntimeError):
        return None  # computed again and replaced


def graph_of(
    map: Map, path: Path | None, options: GraphOptions = GraphOptions(), progress: ProgressBar = silent
) -> ReferenceGraph:
    """The reference graph of a map: read from `path` if that fits, else computed and written there."""
    key = graph_key(map, options)
    graph = read_graph(path, key) if path else None
    if graph is None:
        graph = localize_pairs(map, options, progress)
        if path:
            write_graph(path, graph, key)
    return graph
