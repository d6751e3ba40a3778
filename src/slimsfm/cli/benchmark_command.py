"""`slimsfm benchmark`."""

import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from inspect import Signature, signature, unwrap
from pathlib import Path
from typing import Annotated, Any

import tyro

from slimsfm.cli.execution import Execution, resumable
from slimsfm.cli.networks import Networks
from slimsfm.cli.output import Flat, OutputPath, Stopwatch, console, finish, parse
from slimsfm.cli.results import print_comparisons, print_summary
from slimsfm.datasets import DATASETS
from slimsfm.datasets.base import Dataset
from slimsfm.errors import InputError
from slimsfm.evaluation.benchmark import BenchmarkOptions, BenchmarkSetup
from slimsfm.evaluation.comparison import compare_runs
from slimsfm.evaluation.result_files import digest_of, read_run, write_results
from slimsfm.evaluation.run import run_benchmark
from slimsfm.mapping.build import BuildOptions
from slimsfm.progress import shown
from slimsfm.report.formatting import plural

_USAGE = """usage: slimsfm benchmark DATASET PATH -o RUN   (more: slimsfm benchmark DATASET --help)
       slimsfm benchmark --compare RUN RUN

Data sets: {datasets}."""


def benchmark(
    dataset: Dataset,
    output: OutputPath,
    comparison: Annotated[BenchmarkOptions, Flat] = BenchmarkOptions(),
    build: BuildOptions = BuildOptions(),
    networks: Annotated[Networks, Flat] = Networks(),
    execution: Annotated[Execution, Flat] = Execution(workers=1),
    overwrite: bool = False,
    *,
    command: str,
) -> None:
    """Measure methods and slim maps on a data set: accuracy, speed and size, with what chance there is in it.

    What is done is kept object by object: the same command goes on where it was cut off.

    Args:
        dataset: The data set.
        output: Folder of the run: results.json, table.md, .tex and .csv, queries.csv, and the maps.
        comparison: What is compared.
        build: How photos are mapped; its extractor and matcher are those of the methods.
        networks: Where learned methods run.
        execution: Where objects are measured. Times are comparable only with one worker, the default.
        overwrite: Start anew where the output holds a run of other options.
        command: What was typed; no option, but part of the result.
    """
    watch = Stopwatch()
    networks.apply()
    if (build.extractor, build.matcher) != (BuildOptions().extractor, BuildOptions().matcher):
        raise InputError("build.extractor and build.matcher: name them as --methods EXTRACTOR+MATCHER")
    setup = BenchmarkSetup(folder=output, options=comparison, build=build, progress=shown)
    with resumable():
        run = run_benchmark(dataset, setup, execution.open_executor(), shown, overwrite=overwrite)
    run = replace(run, options={"command": command, **run.options})
    if run.objects:
        print_summary(write_results(run))
    for name, why in run.failed.items():
        console.print(f"{name} failed: {why}", style="red")
    if run.failed:
        name, why = next(iter(run.failed.items()))
        count = f"{len(run.failed)} of {plural(len(run.failed) + len(run.objects), 'object')}"
        raise InputError(f"{name}: {why} ({count} failed; fix the cause and run the same command again)")
    queries = sum(len(one.queries) for one in run.objects)
    counts = f"{plural(len(run.objects), 'object')}, {plural(queries, 'query')}"
    finish(
        f"{output}: {counts}, digest {digest_of(run.objects)}", watch, "report", output, "-o", "report.html"
    )


def compare(before: Path, after: Path) -> None:
    """Show how two runs differ on what they have in common, and how probable that is by chance."""
    old, new = read_run(before), read_run(after)
    print_comparisons(compare_runs(old, new))
    machines = {key: (old.environment.get(key), new.environment.get(key)) for key in ("cpu", "cores", "gpu")}
    for key, (one, other) in machines.items():
        if one != other:
            console.print(f"times are not comparable: {key} {one} and {other}", style="yellow")


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    kind, *rest = arguments or ["--help"]
    if kind in ("-h", "--help"):
        console.print(_USAGE.format(datasets=", ".join(DATASETS)))
    elif kind == "--compare":
        if len(rest) != 2:
            raise InputError(f"--compare takes two runs, got {len(rest)}; see slimsfm benchmark --help")
        compare(*(Path(one) for one in rest))
    elif kind not in DATASETS:
        raise InputError(f"{kind!r} is not a kind of data set; choose one of {', '.join(DATASETS)}")
    else:
        typed = shlex.join(["slimsfm", "benchmark", *arguments])
        parse(_command(DATASETS[kind], typed), rest, kind)


def _command(dataset: type, typed: str) -> Callable[..., None]:
    """The command for one kind of data set: what that cannot do without stands first, and has no flag."""

    def command(*args: Any, **kwargs: Any) -> None:
        benchmark(*args, command=typed, **kwargs)

    options = Annotated[dataset, Flat, tyro.conf.PositionalRequiredArgs]
    taken = [one for name, one in signature(benchmark).parameters.items() if name != "command"]
    parameters = [one.replace(annotation=options) if one.name == "dataset" else one for one in taken]
    plain = unwrap(command)  # a type checker may have wrapped it
    plain.__doc__ = benchmark.__doc__
    plain.__annotations__ = {one.name: one.annotation for one in parameters}
    plain.__dict__["__signature__"] = Signature(parameters)
    return plain
