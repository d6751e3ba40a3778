"""`slimsfm demo`."""

from pathlib import Path
from typing import Annotated

from slimsfm.cli.options import Flags
from slimsfm.cli.output import Stopwatch, console, finish
from slimsfm.cli.tables import print_summary
from slimsfm.datasets.synthetic import SynthesisOptions, Synthetic, synthesize
from slimsfm.errors import OutputError
from slimsfm.evaluation.benchmark import BenchmarkSetup
from slimsfm.evaluation.result_files import write_results
from slimsfm.evaluation.run import run_benchmark
from slimsfm.execution import num_cores, processes
from slimsfm.files.space import check_place
from slimsfm.progress import shown

_OBJECTS = SynthesisOptions(objects=("printed_box", "boulder"), mapping_frames=32, query_frames=16)


def demo(
    output: Annotated[Path, Flags(("-o", "--output"))] = Path("slimsfm-demo"), overwrite: bool = False
) -> None:
    """Build, reduce, localize, measure and report on two objects that the demo renders itself.

    Args:
        output: Folder of the objects, the run with its maps and results.json, and report.html.
        overwrite: Replace an existing demo.
    """
    from slimsfm.report import write_report  # imports matplotlib

    watch = Stopwatch()
    if output.exists() and any(output.iterdir() if output.is_dir() else [output]) and not overwrite:
        raise OutputError(f"{output}: exists already; choose another output or pass `overwrite=True`")
    check_place(output)
    folder, report = output / "objects", output / "report.html"
    with processes(num_cores()) as executor:
        synthesize(folder, _OBJECTS, overwrite=overwrite, progress=shown, executor=executor)
    console.print(f"rendered {', '.join(_OBJECTS.objects)}: {watch}")
    dataset = Synthetic(path=folder, objects=_OBJECTS.objects)
    setup = BenchmarkSetup(folder=output / "run", progress=shown)
    run = run_benchmark(dataset, setup, progress=shown, overwrite=overwrite)
    console.print(f"mapped, reduced, localized: {watch}")
    print_summary(write_results(run))
    write_report(report, run, overwrite=True)
    finish(f"{setup.folder / 'results.json'} and {report}", watch, "build", "PHOTOS", "-o", "MAP")
