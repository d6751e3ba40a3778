"""`slimsfm demo`."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from slimsfm.cli.output import Stopwatch, console, finish, parse, print_rows
from slimsfm.cli.results import maps_in, print_comparison, write_results
from slimsfm.datasets.mapping import map_object
from slimsfm.datasets.onepose import ObjectSequences
from slimsfm.datasets.synthetic import SynthesisOptions, synthesize
from slimsfm.errors import OutputError
from slimsfm.evaluation.benchmark import Benchmark, BenchmarkOptions, benchmark
from slimsfm.evaluation.protocol import PreparedQuery, errors_of, localize_all, prepare, queries_of
from slimsfm.execution import num_cores, processes
from slimsfm.graph import GraphOptions, ReferenceGraph
from slimsfm.graph.io import graph_of
from slimsfm.mapping.io import read_map, weigh_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.photos import read_image
from slimsfm.progress import shown
from slimsfm.report import ObjectReport, QueryFrame, write_report

_OBJECTS = SynthesisOptions(objects=("printed_box", "boulder"), mapping_frames=40, query_frames=24)
_COMPARISON = BenchmarkOptions()
_GRAPH = GraphOptions(edges="localize", candidates="all")  # the paper's
_FRAMES_SHOWN = 4


def demo(
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("slimsfm-demo"), overwrite: bool = False
) -> None:
    """Do the main job on two objects that it renders itself: map, reduce, localize, measure, report.

    Args:
        output: Folder for the objects, their maps, results.json and report.html.
        overwrite: Replace the demo that is there.
    """
    watch = Stopwatch()
    if output.exists() and any(output.iterdir() if output.is_dir() else [output]) and not overwrite:
        raise OutputError(f"{output}: exists already; choose another output or pass --overwrite")
    with processes(num_cores()) as executor:
        objects = synthesize(
            output / "objects", _OBJECTS, overwrite=overwrite, progress=shown, executor=executor
        )
    console.print(f"rendered {', '.join(one.name for one in objects)}: {watch}")
    results: dict[str, tuple[ReferenceGraph, Benchmark]] = {}
    reports = []
    for one in objects:
        graph, result, report = _measure(one, output / "maps" / one.name)
        results[one.name] = (graph, result)
        reports.append(report)
        console.print(f"mapped, reduced and localized {one.name}: {watch}")
    rows = [row for _, result in results.values() for row in result.rows]
    print_rows(rows)
    print_comparison(rows)
    write_results(output / "results.json", results, _COMPARISON)
    write_report(output / "report.html", reports, title="slimsfm demo", overwrite=True)
    finish(f"{output / 'results.json'} and {output / 'report.html'}", watch, "build", "PHOTOS", "-o", "MAP")


def _measure(one: ObjectSequences, folder: Path) -> tuple[ReferenceGraph, Benchmark, ObjectReport]:
    with tempfile.TemporaryDirectory(prefix="slimsfm-build-") as workspace:
        made = map_object(one, Path(workspace), progress=shown)
        write_map(made.map, folder / "full-0", overwrite=True)
    full = read_map(folder / "full-0")
    graph = graph_of(full, folder / "full-0", _GRAPH, progress=shown).graph
    queries = prepare(full, queries_of(one.query), shown)
    result = benchmark(
        full,
        graph,
        queries,
        name=one.name,
        store=maps_in(folder),
        weigh=weigh_map,
        options=_COMPARISON,
        progress=shown,
    )
    reduced = read_map(folder / "default-0")
    report = ObjectReport(
        name=one.name, full=full, reduced=reduced, rows=result.rows, frames=_frames(reduced, queries)
    )
    return graph, result, report


def _frames(map: Map, queries: Sequence[PreparedQuery]) -> tuple[QueryFrame, ...]:
    """A few queries, evenly spaced, as the slim map localizes them."""
    chosen = queries[:: max(1, len(queries) // _FRAMES_SHOWN)][:_FRAMES_SHOWN]
    found = localize_all(map, chosen, "auto")
    return tuple(
        QueryFrame(
            image=read_image(prepared.query.path),
            camera=prepared.query.camera,
            estimated_cam_from_world=one.pose and one.pose.cam_from_world,
            true_cam_from_world=prepared.query.cam_from_world,
            label=prepared.query.path.name,
            relative_corner_error=error.relative_corner_error,
        )
        for prepared, one, error in zip(chosen, found, errors_of(map, chosen, found), strict=True)
    )


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    parse(demo, arguments)
