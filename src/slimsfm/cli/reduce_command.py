"""`slimsfm reduce`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from rich.table import Table

from slimsfm.cli.execution import Execution, resumable
from slimsfm.cli.output import (
    Flat,
    MapPath,
    OutputPath,
    Stopwatch,
    check_output,
    console,
    counts,
    finish,
    parse,
    size,
)
from slimsfm.errors import InputError
from slimsfm.graph import GraphOptions, ReferenceGraph
from slimsfm.graph.io import graph_of, read_given_graph
from slimsfm.graph.source import Edges
from slimsfm.mapping.io import bytes_by_part, read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import shown
from slimsfm.reduction import ReductionOptions, keep_random_images, reduce_map


def reduce(
    map: MapPath,
    /,
    output: OutputPath,
    reduction: Annotated[ReductionOptions, Flat] = ReductionOptions(),
    images: tuple[str, ...] = (),
    random: int | None = None,
    edges: Edges = "auto",
    graph: Path | None = None,
    execution: Annotated[Execution, Flat] = Execution(),
    overwrite: bool = False,
) -> None:
    """Keep a dominating set of a map's images, and the points they see.

    Args:
        map: A map.
        output: Where the slim map is written.
        reduction: How images are chosen.
        images: Keep just these images instead.
        random: Keep this many images drawn at random instead (the paper's baseline).
        edges: How the reference graph is computed; `slimsfm graph --help` explains each way.
        graph: Errors of another system instead: .csv (reference, query, error) or .npz as of `slimsfm graph`.
        execution: Where the graph is computed.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    check_output(output, map, overwrite=overwrite)
    if images and random is not None:
        raise InputError("--images and --random exclude each other")
    full = read_map(map)
    if len(full.images) < 2:
        raise InputError(f"{map}: has one image; there is nothing to reduce")
    if images:
        slim = keep_images(full, images)
    elif random is not None:
        slim = keep_random_images(full, random, seed=reduction.seed)
    else:
        options = GraphOptions(edges=edges, threshold=reduction.threshold)
        if graph:
            found = read_given_graph(graph, full)
        else:
            with resumable():
                found = graph_of(full, map, options, execution.open_executor(), shown).graph
        slim = _dominating(full, found, reduction)
    write_map(slim, output, overwrite=overwrite)
    _print_change(map, full, output, slim)
    finish(
        f"{output}: kept {', '.join(slim.images)}", watch, "localize", output, "IMAGES", "-o", "poses.json"
    )


def _dominating(full: Map, graph: ReferenceGraph, options: ReductionOptions) -> Map:
    reduced = reduce_map(full, graph, options)
    solution = reduced.solution
    proof = "proven smallest" if solution.is_optimal else f"at least {solution.lower_bound} are needed"
    console.print(
        f"reference graph: {graph.num_edges(options.threshold)} edges among {len(graph.names)} images; "
        f"dominating set: {len(solution.chosen)} images ({proof})"
    )
    return reduced.map


def _print_change(full_path: Path, full: Map, slim_path: Path, slim: Map) -> None:
    before = {**counts(full), "bytes": bytes_by_part(full_path)["total"]}
    after = {**counts(slim), "bytes": bytes_by_part(slim_path)["total"]}
    table = Table(box=None, header_style="bold", pad_edge=False)
    for column in ("", "before", "after", "factor"):
        table.add_column(column, justify="right" if column else "left")
    for name in before:
        shown_as = size if name == "bytes" else str
        factor = before[name] / max(after[name], 1)
        table.add_row(name, shown_as(before[name]), shown_as(after[name]), f"{factor:.1f}")
    console.print(table)


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    parse(reduce, arguments)
