"""Methods times strategies times variants of the map, on one object: the paper's comparison."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slimsfm.datasets.base import Making as DatasetMaking
from slimsfm.datasets.base import ObjectSequences
from slimsfm.datasets.mapping import map_object
from slimsfm.evaluation.methods import Method, parse_method
from slimsfm.evaluation.protocol import PreparedQuery, evaluate, prepare, queries_of
from slimsfm.evaluation.results import Cell, MappedObject, ObjectResult, Trial, map_path
from slimsfm.evaluation.variants import Making, Variant, parse_variant
from slimsfm.features.methods import DETECTOR_FREE
from slimsfm.graph import GraphOptions
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.graph.options import Edges
from slimsfm.localization import LocalizationOptions
from slimsfm.mapping.build import BuildOptions
from slimsfm.mapping.io import bytes_by_part, read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import ProgressBar, silent
from slimsfm.reduction import DominatingSetOptions, dominating_set


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """What is compared."""

    methods: tuple[str, ...] = ("sift",)
    """Local features of references and queries, see `slimsfm methods`, with a matcher where images are not to
    be matched by nearest neighbours: aliked+lightglue."""

    strategies: tuple[str, ...] = ("exhaustive", "retrieval", "progressive", "direct")
    """How queries are matched."""

    variants: tuple[str, ...] = ("full", "dominating", "default", "random")
    """Which maps they are matched against: all of it (full), a dominating set of images (dominating, or
    dominating:k=2,rim,budget=8), what `slimsfm reduce` gives by itself (default), as many images as in the
    dominating set drawn at random (random, or random:8), so many points (points:500)."""

    edges: Edges = "localize"
    """How the reference graph is computed; the paper localizes each image from each other one."""

    reduction: DominatingSetOptions = DominatingSetOptions()
    """How dominating sets are chosen."""

    def __post_init__(self) -> None:
        for name in ("methods", "strategies", "variants"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name} must be different ones, got {', '.join(values) or 'none'}")
        _ = self.parsed_methods, self.parsed_variants
        for strategy in self.strategies:
            LocalizationOptions(strategy=strategy)  # refuses what there is not

    @property
    def parsed_methods(self) -> list[Method]:
        """The methods."""
        return [parse_method(one) for one in self.methods]

    @property
    def parsed_variants(self) -> list[Variant]:
        """The variants."""
        return [parse_variant(one) for one in self.variants]


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """Where and how one object is measured."""

    folder: Path
    """The run's folder."""

    options: BenchmarkOptions = BenchmarkOptions()
    """What is compared."""

    build: BuildOptions = BuildOptions()
    """How photos are mapped; methods say with which features."""

    progress: ProgressBar = silent
    """Told of long work."""

    def build_with(self, method: Method) -> BuildOptions:
        """How photos are mapped with a method."""
        return replace(self.build, extractor=method.extractor, matcher=method.matcher or self.build.matcher)

    def dataset_making(self, name: str) -> DatasetMaking:
        """How the data set reconstructs photos whose poses are unknown."""
        return DatasetMaking(
            folder=self.folder / "truth" / name,
            build=self.build_with(self.options.parsed_methods[0]),
            progress=self.progress,
        )


def benchmark_object(sequences: ObjectSequences, bench: Bench) -> ObjectResult:
    """Map an object and localize its queries with every method and strategy against every variant.

    A map for direct matching alone has no line for other strategies, nor one without keypoints for direct.
    """
    queries = [replace(query, path=query.path.resolve()) for query in queries_of(sequences.query)]
    maps, cells = [], []
    for method in bench.options.parsed_methods:
        subject = _Subject(sequences, method, bench)
        making = _making(subject)
        maps.append(_mapped(method, making))
        prepared = prepare(making.map, queries, bench.progress)
        with tempfile.TemporaryDirectory(prefix="slimsfm-benchmark-") as temporary:
            cells += _cells(subject, _stored(subject, making, Path(temporary)), prepared)
    return ObjectResult(
        name=sequences.name,
        box=sequences.box,
        unit=sequences.unit,
        images=sequences.mapping.folder.resolve(),
        queries=tuple(queries),
        maps=tuple(maps),
        cells=tuple(cells),
    )


@dataclass(frozen=True, eq=False)
class _Subject:
    """One object and one method."""

    sequences: ObjectSequences
    method: Method
    bench: Bench

    def map_path(self, variant: str) -> Path:
        """Where the map of a variant is kept."""
        return map_path(self.bench.folder, self.sequences.name, str(self.method), variant)


def _making(subject: _Subject) -> Making:
    """The full map, its reference graph and its dominating set."""
    options, progress = subject.bench.options, subject.bench.progress
    full = _full_map(subject)
    edges = graph_options(options, subject.method)
    graph = load_or_compute_graph(full, subject.map_path("full"), edges, progress=progress).graph
    return Making(
        map=full,
        graph=graph,
        reduction=options.reduction,
        solution=dominating_set(graph, options.reduction, full),
        progress=progress,
    )


def graph_options(options: BenchmarkOptions, method: Method) -> GraphOptions:
    """How the reference graph of a method's map is computed."""
    return GraphOptions(
        edges=options.edges,
        candidates="all",
        threshold=options.reduction.threshold,
        matcher=method.matcher or "auto",
    )


def _full_map(subject: _Subject) -> Map:
    """The map of the mapping sequence; made unless an interrupted run left it."""
    path, bench = subject.map_path("full"), subject.bench
    if not path.exists():
        with tempfile.TemporaryDirectory(prefix="slimsfm-build-") as workspace:
            options = bench.build_with(subject.method)
            write_map(map_object(subject.sequences, Path(workspace), options, bench.progress), path)
    return read_map(path)


def _mapped(method: Method, making: Making) -> MappedObject:
    graph, solution = making.graph, making.solution
    names = tuple(graph.names[i] for i in solution.chosen)
    return MappedObject(
        method=str(method),
        references=len(making.map.images),
        points=len(making.map.point3D_ids),
        edges=graph.num_edges(making.reduction.threshold),
        dominating_set=names,
        lower_bound=int(solution.lower_bound),
        dominating_points=len(keep_images(making.map, names).point3D_ids),
    )


@dataclass(frozen=True, eq=False)
class _StoredMap:
    """A map as read from disk, and its size there."""

    map: Map
    bytes: int


def _stored(subject: _Subject, making: Making, temporary: Path) -> dict[str, list[_StoredMap]]:
    """The maps of every variant; random ones are not kept."""
    found: dict[str, list[_StoredMap]] = {}
    for variant in subject.bench.options.parsed_variants:
        found[variant.name] = []
        for draw, made in enumerate(variant.make(making)):
            path = temporary / f"{len(found)}-{draw}" if variant.is_random else subject.map_path(variant.name)
            if made is not making.map:
                write_map(made, path, overwrite=True)
            found[variant.name].append(_StoredMap(read_map(path), bytes_by_part(path)["total"]))
    return found


def _cells(
    subject: _Subject, stored: dict[str, list[_StoredMap]], queries: Sequence[PreparedQuery]
) -> Iterator[Cell]:
    """Strategy by strategy, variant by variant."""
    for strategy in subject.bench.options.strategies:
        for variant, maps in stored.items():
            if maps and _is_possible(strategy, maps[0].map):
                trials = tuple(_trial(subject, one, strategy, queries) for one in maps)
                yield Cell(method=str(subject.method), strategy=strategy, variant=variant, trials=trials)


def _trial(subject: _Subject, stored: _StoredMap, strategy: str, queries: Sequence[PreparedQuery]) -> Trial:
    matcher, progress = subject.method.matcher or "auto", subject.bench.progress
    return Trial(
        references=len(stored.map.images),
        points=len(stored.map.point3D_ids),
        map_bytes=stored.bytes,
        outcomes=evaluate(stored.map, queries, strategy, matcher, progress, subject.sequences.model),
    )


def _is_possible(strategy: str, map: Map) -> bool:
    if strategy == "direct":
        return map.info.extractor not in DETECTOR_FREE
    return not map.is_for_direct_matching
