"""`slimsfm demo`."""

from pathlib import Path
from typing import Annotated

from slimsfm.cli.options import Flags
from slimsfm.cli.output import Stopwatch, console, finish
from slimsfm.cli.serve_command import check_can_serve, serve_until_stopped
from slimsfm.cli.tables import print_summary
from slimsfm.datasets.synthetic import SynthesisOptions, Synthetic, synthesize
from slimsfm.errors import OutputError
from slimsfm.evaluation.benchmark import BenchmarkSetup
from slimsfm.evaluation.result_files import write_results
from slimsfm.evaluation.results import Run
from slimsfm.evaluation.run import run_benchmark
from slimsfm.execution import num_cores, processes
from slimsfm.files.space import check_place
from slimsfm.progress import shown
from slimsfm.tracking.video import check_format

_OBJECTS = SynthesisOptions(objects=("printed_box", "boulder"), mapping_frames=28, query_frames=9)


def demo(
    output: Annotated[Path, Flags(("-o", "--output"))] = Path("slimsfm-demo"),
    overwrite: bool = False,
    serve: bool = False,
    port: int = 8000,
) -> None:
    """Build, reduce, localize, measure and report on two objects that the demo renders itself.

    Args:
        output: Folder of the objects, the run with its maps and results.json, and report.html.
        overwrite: Replace an existing demo.
        serve: In the end, open the page for phones in the browser, with a film of an object as its camera.
        port: Port of the page; 0 picks a free one.
    """
    from slimsfm.report import write_report  # imports matplotlib

    if serve:
        check_can_serve()
        check_format("film.webm")
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
    if serve:
        _serve_filmed(run, output / "film.webm", port)
        return
    finish(f"{setup.folder / 'results.json'} and {report}", watch, "build", "PHOTOS", "-o", "MAP")


def _serve_filmed(run: Run, film: Path, port: int) -> None:
    """Film an object and open the page with this film, on the map that reduction recommends."""
    from slimsfm.serve.film import write_film
    from slimsfm.serve.options import ServeOptions
    from slimsfm.serve.running import Binding

    name = _OBJECTS.objects[0]
    with processes(num_cores()) as executor:
        write_film(film, name, overwrite=True, progress=shown, executor=executor)
    slim, full = (run.map_path(name, "sift", variant) for variant in ("default", "full"))
    options = ServeOptions(maps=(slim if slim.exists() else full,), film=film)
    serve_until_stopped(options, Binding(port=port), opens_page=True)
