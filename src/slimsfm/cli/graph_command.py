"""`slimsfm graph`."""

import json as json_format
from pathlib import Path
from typing import Annotated

import numpy as np

from slimsfm.cli.arguments import Execution, Networks, resumable
from slimsfm.cli.options import Advanced, Flags, MapPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish
from slimsfm.files import replacing
from slimsfm.graph import GraphOptions, GraphRun
from slimsfm.graph.compute import estimate_recall, load_or_compute_graph
from slimsfm.graph.edge_sources import resolve_edges
from slimsfm.graph.io import write_graph
from slimsfm.mapping.io import read_map
from slimsfm.progress import shown


def graph(
    map: MapPath,
    /,
    edges: GraphOptions = GraphOptions(),
    execution: Annotated[Execution, Advanced()] = Execution(),
    networks: Annotated[Networks, Advanced()] = Networks(),
    output: Annotated[Path | None, Flags(("-o", "--output"))] = None,
    json: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Find out which reference images localize which others.

    The graph is kept in the map, and `reduce` uses it. After an interruption the same command resumes where
    it stopped.

    Args:
        map: The map; the graph is kept in its folder.
        edges: How edges are found.
        execution: Where the work is done.
        networks: Where learned methods run.
        output: Also write the graph here, as npz.
        json: Write the statistics here.
        overwrite: Replace existing files.
    """
    watch = Stopwatch()
    networks.apply()
    for path in (output, json):
        if path:
            check_output(path, overwrite=overwrite)
    map_ = read_map(map)
    with resumable():
        run = load_or_compute_graph(map_, map, edges, execution.open_executor(), shown)
    figures = _figures(run, edges.threshold)
    for name, value in figures.items():
        console.print(f"{name:<20} {value}")
    if resolve_edges(map_, edges) == "localize" and edges.candidates == "likely":
        share = estimate_recall(map_, run, edges)
        console.print(f"{'recall':<20} {100 * share:.2f} % of the edges are on the pairs tried (estimated)")
    if output:
        write_graph(output, run.graph)
    if json:
        with replacing(json, overwrite=overwrite) as partial:
            partial.write_text(json_format.dumps(figures, indent=2) + "\n")
    finish(f"reference graph by {resolve_edges(map_, edges)}", watch, "reduce", map, "-o", f"{map}-small")


def _figures(run: GraphRun, threshold: float) -> dict:
    found = run.graph
    count, edges = len(found.names), found.num_edges(threshold)
    out_degrees, in_degrees = found.degrees(threshold)
    return {
        "images": count,
        "pairs_tried": run.pairs_tried,
        "edges": edges,
        "density": edges / max(count * (count - 1), 1),
        "isolated": int(found.isolated(threshold).sum()),
        "components": found.num_components(threshold),
        "out_degree": _range(out_degrees),
        "in_degree": _range(in_degrees),
        "seconds": {stage: round(seconds, 4) for stage, seconds in run.seconds.items()},
    }


def _range(degrees: np.ndarray) -> dict[str, int | float]:
    return {"min": int(degrees.min()), "median": float(np.median(degrees)), "max": int(degrees.max())}
