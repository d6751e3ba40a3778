"""`slimsfm frontier`."""

import json as json_format
from pathlib import Path
from typing import Annotated

from slimsfm.cli.choices import frontier_to_json, print_frontier, promise
from slimsfm.cli.execution import Execution, resumable
from slimsfm.cli.options import Advanced, MapPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish
from slimsfm.errors import InputError
from slimsfm.files import replacing
from slimsfm.graph import GraphOptions
from slimsfm.graph.io import load_or_compute_graph
from slimsfm.graph.source import Edges
from slimsfm.mapping.io import bytes_by_part, read_map, weigh_map
from slimsfm.mapping.map import check_has_features
from slimsfm.progress import shown
from slimsfm.reduction import USES, FrontierOptions, frontier, recommend
from slimsfm.report.curves import curves_figure
from slimsfm.report.figures import check_figure, save_figure


def frontier_of(
    map: MapPath,
    /,
    comparison: FrontierOptions = FrontierOptions(uses=USES),
    edges: Edges = "auto",
    json: Path | None = None,
    curves: Path | None = None,
    execution: Annotated[Execution, Advanced()] = Execution(),
    overwrite: bool = False,
) -> None:
    """Tell what a map can be reduced to and what each way is predicted to lose; recommend one a use.

    Args:
        map: A map.
        comparison: What is compared.
        edges: How the reference graph is computed, by which images are chosen.
        json: Write all figures here.
        curves: Draw loss and time over size here, as .svg, .png or .pdf.
        execution: Where the reference graph is computed.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    for path in (json, curves):
        if path:
            check_output(path, map, overwrite=overwrite)
    if curves:
        check_figure(curves)
    full, size = read_map(map), bytes_by_part(map)["total"]
    check_has_features(full)
    if len(full.images) < 2:
        raise InputError(f"{map}: has one image; there is nothing to reduce")
    graph = None
    if "images" in comparison.uses:
        with resumable():
            graph = load_or_compute_graph(
                full, map, GraphOptions(edges=edges), execution.open_executor(), shown
            ).graph
    found = frontier(full, graph, weigh_map, comparison, shown)
    tried = {one.choice.use for one in found.candidates}
    recommended = {use: recommend(found, use) for use in comparison.uses if use in tried}
    print_frontier(found, recommended, size)
    for use, one in recommended.items():
        console.print(f"for {use}: {one.choice.method}, {one.choice.detail}: {promise(map, full, one)}")
    if json:
        with replacing(json, overwrite=overwrite) as partial:
            data = frontier_to_json(found, recommended, full, size)
            partial.write_text(json_format.dumps(data, indent=2) + "\n")
    if curves:
        save_figure(curves_figure(found, recommended, size), curves, overwrite=overwrite)
    finish(f"{len(found.candidates)} ways to reduce {map}", watch, "reduce", map, "-o", f"{map}-small")
