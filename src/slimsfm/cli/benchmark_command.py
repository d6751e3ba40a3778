"""`slimsfm benchmark`."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from slimsfm.cli.networks import Networks
from slimsfm.cli.output import Flat, ImagesPath, OutputPath, Stopwatch, console, finish, parse, print_rows
from slimsfm.cli.results import maps_in, print_comparison, write_results
from slimsfm.datasets.images import hold_out, query_names
from slimsfm.errors import InputError
from slimsfm.evaluation.benchmark import BenchmarkOptions, benchmark
from slimsfm.evaluation.protocol import held_out_queries, prepare
from slimsfm.graph import GraphOptions
from slimsfm.graph.io import graph_of
from slimsfm.graph.source import Edges
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.io import read_map, weigh_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.photos import list_images
from slimsfm.progress import shown


def benchmark_images(
    images: ImagesPath,
    /,
    output: OutputPath,
    extractor: str | None = None,
    query_every: int = 3,
    edges: Edges = "localize",
    comparison: Annotated[BenchmarkOptions, Flat] = BenchmarkOptions(),
    build: BuildOptions = BuildOptions(),
    networks: Annotated[Networks, Flat] = Networks(),
    keep_maps: Path | None = None,
) -> None:
    """Measure full against slim maps on any folder of photos.

    All photos are reconstructed together, which gives pseudo ground truth; every n-th is held out as a query.

    Args:
        images: Folder of photos.
        output: Folder for results.json and the pseudo-ground-truth model, which is reused where it exists.
        extractor: Local features of references and queries, see `slimsfm methods`.
        query_every: Every n-th image in order of name, from the first, is a query; the rest are references.
        edges: How the reference graph is computed; the paper localizes each image from each other one.
        comparison: What is compared.
        build: How the pseudo ground truth is reconstructed.
        networks: Where learned methods run.
        keep_maps: Keep the maps that are compared in this folder.
    """
    watch = Stopwatch()
    networks.apply()
    matcher = None if comparison.matcher == "auto" else comparison.matcher
    build = replace(build, extractor=extractor or build.extractor, matcher=matcher or build.matcher)
    query_names(list_images(images), query_every)  # refused before the long work, not after
    truth = _ground_truth(images, output / "pseudo-ground-truth", build)
    names = query_names(list(truth.images), query_every)
    references = hold_out(truth, names)
    options = GraphOptions(edges=edges, candidates="all", matcher=comparison.matcher)
    graph = graph_of(references, output, options, progress=shown).graph
    queries = held_out_queries(truth, images, names)
    prepared = prepare(references, queries, shown)
    with tempfile.TemporaryDirectory(prefix="slimsfm-benchmark-") as temporary:
        result = benchmark(
            references,
            graph,
            prepared,
            name=images.name,
            store=maps_in(keep_maps or Path(temporary)),
            weigh=weigh_map,
            options=comparison,
            progress=shown,
        )
    print_rows(result.rows)
    print_comparison(result.rows)
    write_results(output / "results.json", {images.name: (graph, result)}, comparison)
    finish(
        f"{output / 'results.json'}: {len(names)} queries",
        watch,
        "reduce",
        output / "pseudo-ground-truth",
        "-o SMALL",
    )


def _ground_truth(images: Path, path: Path, build: BuildOptions) -> Map:
    names = list_images(images)
    if not path.exists():
        with tempfile.TemporaryDirectory(prefix="slimsfm-build-") as workspace:
            made = build_map(images, Path(workspace), build, progress=shown)
            write_map(made.map, path)
    truth = read_map(path)
    left_out = sorted(set(names) - truth.images.keys())
    if strangers := truth.images.keys() - set(names):
        raise InputError(
            f"{path}: is of other images ({min(strangers)} is not in {images}); choose another output folder"
        )
    if left_out:
        console.print(f"not in the model and so left out: {', '.join(left_out)}", style="yellow")
    return truth


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    kind, *rest = arguments or ["--help"]
    if kind in ("-h", "--help"):
        console.print(
            "usage: slimsfm benchmark images DIR -o RESULTS   (more: slimsfm benchmark images --help)"
        )
        return
    if kind not in _KINDS:
        raise InputError(f"{kind!r} is no kind of data set; there is {', '.join(_KINDS)}")
    parse(_KINDS[kind], rest)


_KINDS = {"images": benchmark_images}
