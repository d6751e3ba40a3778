"""What the commands that measure share: storing maps, comparing rows, writing results."""

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

from slimsfm.cli.output import console
from slimsfm.evaluation.benchmark import Benchmark, BenchmarkOptions, Store, StoredMap
from slimsfm.evaluation.table import Row
from slimsfm.files import replacing
from slimsfm.graph import ReferenceGraph
from slimsfm.mapping.io import bytes_by_part, read_map, write_map
from slimsfm.mapping.map import Map


def maps_in(folder: Path) -> Store:
    """A store that keeps maps in a folder."""

    def store(map: Map, name: str) -> StoredMap:
        path = folder / name
        write_map(map, path, overwrite=True)
        return read_map(path), bytes_by_part(path)["total"]

    return store


def print_comparison(rows: Sequence[Row]) -> None:
    """Say, for each object and strategy, what a slim map gains and what it costs.

    Points chosen for direct matching stand against the full map matched exhaustively, where that was done.
    """
    full = {(row.object, row.strategy): row for row in rows if row.variant == "full"}
    for slim in (row for row in rows if row.variant != "full"):
        strategies = ("exhaustive", slim.strategy) if slim.variant == "default" else (slim.strategy,)
        against = next((full[slim.object, one] for one in strategies if (slim.object, one) in full), None)
        if against:
            smaller = against.map_bytes / slim.map_bytes
            console.print(
                f"{slim.object}, {slim.strategy}: {slim.variant} is {speedup(against, slim):.1f}x faster in "
                f"matching and pose than full, {against.strategy}, and {smaller:.0f}x smaller; "
                f"ADD-0.1d {against.scores.add[0.1]:.1f} -> {slim.scores.add[0.1]:.1f}"
            )


def speedup(full: Row, slim: Row) -> float:
    """How many times faster matching and pose are."""
    a, b = full.scores.seconds, slim.scores.seconds
    return (a.match + a.pose) / (b.match + b.pose)


def write_results(
    path: Path, objects: Mapping[str, tuple[ReferenceGraph, Benchmark]], options: BenchmarkOptions
) -> None:
    """Write rows, dominating sets, options and environment as JSON, replacing earlier results."""
    threshold = options.reduction.threshold
    data = {
        "rows": [row.to_json() for _, result in objects.values() for row in result.rows],
        "objects": {
            name: {
                "references": len(graph.names),
                "edges": graph.num_edges(threshold),
                "dominating_set": [graph.names[i] for i in result.solution.chosen],
                "lower_bound": result.solution.lower_bound,
            }
            for name, (graph, result) in objects.items()
        },
        "options": asdict(options),
        "environment": _environment(),
    }
    with replacing(path, overwrite=True) as partial:
        partial.write_text(json.dumps(data, indent=2) + "\n")


def _environment() -> dict[str, str]:
    packages = ("slimsfm", "numpy", "scipy", "pycolmap", "poselib", "opencv-python-headless")
    return {
        **{package: version(package) for package in packages},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cpus": str(len(os.sched_getaffinity(0))),
    }
