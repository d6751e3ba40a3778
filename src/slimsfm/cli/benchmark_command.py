"""`slimsfm benchmark`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Execution, Networks, Reading, resumable
from slimsfm.cli.options import Advanced, Argument, OutputPath, Positional, Prefixed, Typed
from slimsfm.cli.output import Stopwatch, console, finish, plural
from slimsfm.cli.tables import print_comparisons, print_summary, print_support
from slimsfm.datasets.base import Dataset
from slimsfm.errors import InputError
from slimsfm.evaluation.benchmark import BenchmarkOptions, BenchmarkSetup
from slimsfm.evaluation.comparison import compare_runs
from slimsfm.evaluation.result_files import digest_of, read_run, write_results
from slimsfm.evaluation.run import run_benchmark
from slimsfm.files.space import check_place
from slimsfm.mapping.build import BuildOptions
from slimsfm.progress import shown


def benchmark(
    dataset: Annotated[Dataset, Positional],
    output: OutputPath,
    comparison: Annotated[BenchmarkOptions, Advanced(("edges", "reduction"))] = BenchmarkOptions(),
    build: Annotated[BuildOptions, Prefixed, Advanced()] = BuildOptions(),
    networks: Annotated[Networks, Advanced()] = Networks(),
    reading: Annotated[Reading, Advanced()] = Reading(),
    execution: Annotated[Execution, Advanced()] = Execution(workers=1),
    overwrite: bool = False,
    *,
    command: Annotated[str, Typed],
) -> None:
    """Measure the accuracy, speed and size of full and reduced maps on a data set, with confidence intervals.

    Results are saved after each object: after an interruption, the same command resumes.

    Args:
        dataset: The data set.
        output: Folder of the run: results.json, table.md, .tex and .csv, queries.csv and the maps.
        comparison: What is compared.
        build: How maps are built from photos. Extractor and matcher come from the methods.
        networks: Where learned methods run.
        reading: Limits on what is read.
        execution: Where objects are measured. Times are comparable only with one worker, the default.
        overwrite: Start from scratch if the output contains a run with other options.
        command: The command line, which is part of the results.
    """
    watch = Stopwatch()
    networks.apply()
    reading.apply()
    if (build.extractor, build.matcher) != (BuildOptions().extractor, BuildOptions().matcher):
        raise InputError("build.extractor and build.matcher are ignored; use `methods=EXTRACTOR+MATCHER`")
    check_place(output)
    setup = BenchmarkSetup(folder=output, options=comparison, build=build, progress=shown)
    with resumable():
        run = run_benchmark(dataset, setup, execution.open_executor(), shown, overwrite=overwrite)
    run = replace(run, options={"command": command, **run.options})
    if run.objects:
        print_summary(write_results(run))
        print_support(run.objects)
    for name, why in run.failed.items():
        console.print(f"{name}: not measured: {why}", style="red")
    if run.failed:
        name, why = next(iter(run.failed.items()))
        count = f"{len(run.failed)} of {plural(len(run.failed) + len(run.objects), 'object')}"
        raise InputError(f"{name}: {why} ({count} could not be measured; fix this and run the command again)")
    objects = plural(len(run.objects), "object")
    queries = plural(sum(len(one.queries) for one in run.objects), "query", "queries")
    skipped = sum(len(one.skipped) for one in run.objects)
    contradicted = sum(len(one.contradicted) for one in run.objects)
    reasons = [f"{skipped} skipped"] * bool(skipped)
    reasons += [f"{plural(contradicted, 'image')} with contradicted poses left out"] * bool(contradicted)
    left_out = f" ({', '.join(reasons)})" if reasons else ""
    what = f"{output}: {objects}, {queries}{left_out}, digest {digest_of(run.objects)}"
    finish(what, watch, "report", output, "-o", "report.html")


def compare(before: Annotated[Path, Argument("BEFORE")], after: Annotated[Path, Argument("AFTER")]) -> None:
    """Show how two runs differ on the objects they share, and how likely the difference is by chance.

    Args:
        before: Folder of a run.
        after: Folder of the run to compare with it.
    """
    old, new = read_run(before), read_run(after)
    print_comparisons(compare_runs(old, new))
    machines = {key: (old.environment.get(key), new.environment.get(key)) for key in ("cpu", "cores", "gpu")}
    for key, (one, other) in machines.items():
        if one != other:
            console.print(f"times are not comparable: {key} {one}, then {other}", style="yellow")
