"""Compare methods, strategies and variants of the map on one object, as in the paper."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slimsfm.datasets.base import LoadOptions, ObjectSequences, map_object
from slimsfm.evaluation.results import (
    MappedObject,
    MapRun,
    Measurement,
    ObjectResult,
    PreparedQuery,
    evaluate,
    map_path,
    prepare_queries,
    queries_of,
    readable_queries,
)
from slimsfm.evaluation.right_poses import with_marks, with_right_poses
from slimsfm.evaluation.variants import Variant, VariantInputs, parse_variant
from slimsfm.features.registry import EXTRACTORS, MATCHERS, plugins
from slimsfm.files import working_folder
from slimsfm.graph import GraphOptions
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.graph.edge_sources import Edges
from slimsfm.localization import LocalizationOptions
from slimsfm.localization.options import supports
from slimsfm.localization.rounds import ExtractionChoice
from slimsfm.mapping.build import BuildOptions
from slimsfm.mapping.io import bytes_by_part, read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import ProgressBar, silent
from slimsfm.reduction import DominatingSetOptions, dominating_set

IN_ROUNDS = "direct", "progressive"
"""Strategies whose queries are extracted in rounds; those of the paper take the whole image."""


@dataclass(frozen=True)
class Method:
    """Local features and their matcher."""

    extractor: str
    """Name of the extractor, see `slimsfm methods`."""

    matcher: str | None = None
    """Name of the matcher; None selects nearest neighbors, or the extractor itself if it has no keypoints."""

    def __str__(self) -> str:
        return self.extractor if self.matcher is None else f"{self.extractor}+{self.matcher}"


def parse_method(text: str) -> Method:
    """Read a method: EXTRACTOR, or EXTRACTOR+MATCHER as in `aliked+lightglue`.

    Raises:
        ValueError: The extractor or the matcher is unknown.
    """
    extractor, plus, matcher = text.partition("+")
    extractors, matchers = {**EXTRACTORS, **plugins("extractor")}, {**MATCHERS, **plugins("matcher")}
    if extractor not in extractors:
        raise ValueError(f"the extractor of a method must be one of {', '.join(extractors)}, got {text!r}")
    if plus and matcher not in matchers:
        raise ValueError(f"the matcher of a method must be one of {', '.join(matchers)}, got {text!r}")
    return Method(extractor, matcher or None)


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """What to compare."""

    methods: tuple[str, ...] = ("sift",)
    """Local features of references and queries, see `slimsfm methods`. Add a matcher to replace nearest
    neighbors: aliked+lightglue."""

    strategies: tuple[str, ...] = ("exhaustive", "retrieval", "progressive", "direct")
    """How queries are matched."""

    variants: tuple[str, ...] = ("full", "dominating", "default", "random")
    """Maps to match against: the full map (full), a dominating set of images (dominating, or
    dominating:k=2,rim,budget=8), the default result of `slimsfm reduce` (default), as many random images as
    the dominating set has (random, or random:8), a number of points (points:500)."""

    edges: Edges = "localize"
    """How to compute the reference graph; the paper localizes each image from each other image."""

    extraction: ExtractionChoice = "rounds"
    """Image that features are extracted from with the strategies progressive and direct: a small one first
    (rounds) or the whole one (whole). The other strategies are the paper's, and always take the whole one."""

    reduction: DominatingSetOptions = DominatingSetOptions()
    """How to choose dominating sets."""

    def __post_init__(self) -> None:
        for name in ("methods", "strategies", "variants"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name} must be distinct and not empty, got {', '.join(values) or 'none'}")
        _ = self.parsed_methods, self.parsed_variants
        for strategy in self.strategies:
            LocalizationOptions(strategy=strategy, extraction=self.extraction)  # raises for unknown values

    @property
    def parsed_methods(self) -> list[Method]:
        """`methods`, parsed."""
        return [parse_method(one) for one in self.methods]

    @property
    def parsed_variants(self) -> list[Variant]:
        """`variants`, parsed."""
        return [parse_variant(one) for one in self.variants]


@dataclass(frozen=True, kw_only=True, eq=False)
class BenchmarkSetup:
    """Folder and options of a benchmark."""

    folder: Path
    """Folder of the run."""

    options: BenchmarkOptions = BenchmarkOptions()
    """What to compare."""

    build: BuildOptions = BuildOptions()
    """How to map photos; the methods override extractor and matcher."""

    progress: ProgressBar = silent
    """Progress callback."""

    def build_options(self, method: Method) -> BuildOptions:
        """How to map photos with a method."""
        return replace(self.build, extractor=method.extractor, matcher=method.matcher or self.build.matcher)

    def load_options(self, name: str) -> LoadOptions:
        """How the data set loads an object; photos without poses are reconstructed with the first method."""
        return LoadOptions(
            folder=self.folder / "truth" / name,
            build=self.build_options(self.options.parsed_methods[0]),
            progress=self.progress,
        )


def benchmark_object(sequences: ObjectSequences, setup: BenchmarkSetup) -> ObjectResult:
    """Map an object and localize its queries with every method and strategy against every variant.

    Impossible combinations are left out: a map that supports only direct matching has no measurement for
    other strategies, and a map without keypoints has none for direct matching. Queries that cannot be read
    are skipped with a warning, and so are images whose true poses the others contradict.

    Raises:
        ImageError: No query can be read.
        InputError: Too few images have true poses that are not contradicted.
    """
    right = with_right_poses(sequences, setup.progress)
    sequences = right.sequences
    queries = [replace(query, path=query.path.resolve()) for query in queries_of(sequences.query)]
    queries, skipped = readable_queries(queries, sequences.query.folder)
    maps, measurements = [], []
    for method in setup.options.parsed_methods:
        task = _MethodTask(sequences, method, setup)
        inputs = _variant_inputs(task)
        maps.append(_mapped(method, inputs))
        prepared = prepare_queries(inputs.map, queries, setup.progress)
        with working_folder() as temporary:
            measurements += _measurements(task, _stored_maps(task, inputs, temporary), prepared)
    return ObjectResult(
        name=sequences.name,
        box=sequences.box,
        unit=sequences.unit,
        images=sequences.mapping.folder.resolve(),
        queries=tuple(queries),
        maps=tuple(maps),
        measurements=tuple(measurements),
        skipped=skipped,
        contradicted=right.contradicted,
    )


@dataclass(frozen=True, eq=False)
class _MethodTask:
    """One object to measure with one method."""

    sequences: ObjectSequences
    method: Method
    setup: BenchmarkSetup

    def map_path(self, variant: str) -> Path:
        """Folder of the map of a variant."""
        return map_path(self.setup.folder, self.sequences.name, str(self.method), variant)


def _variant_inputs(task: _MethodTask) -> VariantInputs:
    """The full map, its reference graph and its dominating set."""
    options, progress = task.setup.options, task.setup.progress
    full = _full_map(task)
    edges = graph_options(options, task.method)
    graph = load_or_compute_graph(full, task.map_path("full"), edges, progress=progress).graph
    return VariantInputs(
        map=full,
        graph=graph,
        reduction=options.reduction,
        solution=dominating_set(graph, options.reduction, full),
        progress=progress,
    )


def graph_options(options: BenchmarkOptions, method: Method) -> GraphOptions:
    """How to compute the reference graph of a map with a method."""
    return GraphOptions(
        edges=options.edges,
        candidates="all",
        threshold=options.reduction.threshold,
        matcher=method.matcher or "auto",
    )


def _full_map(task: _MethodTask) -> Map:
    """The map of the mapping sequence; built unless an interrupted run has stored it."""
    path, setup = task.map_path("full"), task.setup
    if not path.exists():
        with working_folder() as workspace:
            options = setup.build_options(task.method)
            made = map_object(task.sequences, workspace, options, setup.progress)
            write_map(with_marks(made, setup.progress), path)
    return read_map(path)


def _mapped(method: Method, inputs: VariantInputs) -> MappedObject:
    graph, solution = inputs.graph, inputs.solution
    names = tuple(graph.names[i] for i in solution.chosen)
    return MappedObject(
        method=str(method),
        references=len(inputs.map.images),
        points=len(inputs.map.point3D_ids),
        edges=graph.num_edges(inputs.reduction.threshold),
        dominating_set=names,
        lower_bound=int(solution.lower_bound),
        dominating_points=len(keep_images(inputs.map, names).point3D_ids),
        quality=inputs.map.info.quality,
        notes=inputs.map.info.notes,
    )


@dataclass(frozen=True, eq=False)
class _StoredMap:
    """A map that was read from disk, and its size there."""

    map: Map
    bytes: int


def _stored_maps(task: _MethodTask, inputs: VariantInputs, temporary: Path) -> dict[str, list[_StoredMap]]:
    """The maps of every variant; random ones are stored in the temporary folder."""
    found: dict[str, list[_StoredMap]] = {}
    for variant in task.setup.options.parsed_variants:
        found[variant.name] = []
        for draw, made in enumerate(variant.make(inputs)):
            path = temporary / f"{len(found)}-{draw}" if variant.is_random else task.map_path(variant.name)
            if made is not inputs.map:
                write_map(made, path, overwrite=True)
            found[variant.name].append(_StoredMap(read_map(path), bytes_by_part(path)["total"]))
    return found


def _measurements(
    task: _MethodTask, stored: dict[str, list[_StoredMap]], queries: Sequence[PreparedQuery]
) -> Iterator[Measurement]:
    for strategy in task.setup.options.strategies:
        for variant, maps in stored.items():
            if maps and supports(strategy, maps[0].map):
                runs = tuple(_map_run(task, one, strategy, queries) for one in maps)
                yield Measurement(method=str(task.method), strategy=strategy, variant=variant, map_runs=runs)


def _map_run(
    task: _MethodTask, stored: _StoredMap, strategy: str, queries: Sequence[PreparedQuery]
) -> MapRun:
    matcher, progress = task.method.matcher or "auto", task.setup.progress
    extraction = task.setup.options.extraction if strategy in IN_ROUNDS else "whole"
    return MapRun(
        references=len(stored.map.images),
        points=len(stored.map.point3D_ids),
        map_bytes=stored.bytes,
        outcomes=evaluate(stored.map, queries, strategy, matcher, progress, task.sequences.model, extraction),
    )
