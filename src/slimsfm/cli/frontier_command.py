"""`slimsfm frontier`."""

import json as json_format
from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Execution
from slimsfm.cli.options import Advanced, MapPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish
from slimsfm.cli.tables import (
    frontier_to_json,
    kept_graph,
    print_frontier,
    print_speed,
    promise,
    read_reducible,
)
from slimsfm.files import replacing
from slimsfm.mapping.io import bytes_by_part
from slimsfm.progress import shown
from slimsfm.reduction import FrontierOptions, apply_choice, frontier, recommend
from slimsfm.report.figures import check_figure, save_figure
from slimsfm.report.tradeoffs import curves_figure


def frontier_of(
    map: MapPath,
    /,
    comparison: FrontierOptions = FrontierOptions(),
    json: Path | None = None,
    curves: Path | None = None,
    execution: Annotated[Execution, Advanced()] = Execution(),
    overwrite: bool = False,
) -> None:
    """List what a map can be reduced to and what each way is predicted to lose; recommend one per use.

    Args:
        map: The full map.
        comparison: The ways to compare.
        json: Write all figures here.
        curves: Draw loss and time against size here, as .svg, .png or .pdf.
        execution: Where the reference graph is computed.
        overwrite: Replace existing files.
    """
    watch = Stopwatch()
    for path in (json, curves):
        if path:
            check_output(path, map, overwrite=overwrite)
    if curves:
        check_figure(curves)
    full, size = read_reducible(map), bytes_by_part(map)["total"]
    found = frontier(full, comparison, graph=kept_graph(map, execution), progress=shown)
    tried = {one.choice.use for one in found.candidates}
    recommended = {use: recommend(found, use) for use in comparison.uses if use in tried}
    print_frontier(found, recommended, size)
    for use, one in recommended.items():
        console.print(f"for {use}: {one.choice.method}, {one.choice.detail}: {promise(map, full, one)}")
        print_speed(full, apply_choice(full, one.choice), f" for {use}")
    if json:
        with replacing(json, overwrite=overwrite) as partial:
            data = frontier_to_json(found, recommended, full, size)
            partial.write_text(json_format.dumps(data, indent=2) + "\n")
    if curves:
        save_figure(curves_figure(found, recommended, size), curves, overwrite=overwrite)
    finish(f"{len(found.candidates)} ways to reduce {map}", watch, "reduce", map, "-o", f"{map}-small")
