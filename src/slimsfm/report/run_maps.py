"""The maps and the reference graph of an object, read from a run's folder."""

from dataclasses import dataclass

from slimsfm.evaluation.benchmark import BenchmarkOptions, graph_options, parse_method
from slimsfm.evaluation.results import MappedObject, ObjectResult, Run
from slimsfm.evaluation.variants import parse_variant
from slimsfm.graph import ReferenceGraph
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from slimsfm.reduction import DominatingSetOptions


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenedObject:
    """An object and, of one method, its maps."""

    result: ObjectResult
    """What was measured."""

    mapped: MappedObject
    """What the method made of it."""

    maps: dict[str, Map]
    """Maps by variant, the full one first; without random ones, which no run keeps."""

    graph: ReferenceGraph
    """Of the full map."""

    threshold: float
    """Largest relative corner error of the graph's edges."""


def open_object(run: Run, result: ObjectResult, method: str) -> OpenedObject:
    """Read what a run keeps of an object.

    Raises:
        MapError: A map is missing or damaged.
    """
    variants = [one.variant for one in result.measurements if one.method == method]
    kept = [one for one in dict.fromkeys(("full", *variants)) if not parse_variant(one).is_random]
    maps = {variant: read_map(run.map_path(result.name, method, variant)) for variant in kept}
    threshold = run.options["reduction"]["threshold"]
    asked = BenchmarkOptions(
        edges=run.options["edges"], reduction=DominatingSetOptions(threshold=threshold)
    )  # all that the graph depends on
    options = graph_options(asked, parse_method(method))
    return OpenedObject(
        result=result,
        mapped=next(one for one in result.maps if one.method == method),
        maps=maps,
        graph=load_or_compute_graph(maps["full"], run.map_path(result.name, method, "full"), options).graph,
        threshold=threshold,
    )
