"""`slimsfm figures`."""

from pathlib import Path
from typing import Annotated, Literal

from slimsfm.cli.options import Argument, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish
from slimsfm.cli.tables import print_map_warnings
from slimsfm.errors import InputError
from slimsfm.evaluation.result_files import read_run
from slimsfm.progress import shown


def figures(
    run: Annotated[Path, Argument("RUN")],
    /,
    output: OutputPath,
    format: Literal["png", "svg", "pdf"] = "png",
    overwrite: bool = False,
) -> None:
    """Draw the figures of a run of `slimsfm benchmark`: OUTPUT/OBJECT/METHOD/graph.png and so on.

    Queries are drawn as images and, with PyAV, as a video.

    Args:
        run: Folder of a run, with its maps.
        output: Folder for the figures.
        format: File format of the figures that are not photos.
        overwrite: Replace existing files; other files in the folder stay.
    """
    from slimsfm.report import write_figures  # imports matplotlib

    watch = Stopwatch()
    check_output(output, run, overwrite=overwrite)
    measured = read_run(run)
    if not measured.objects:
        raise InputError(f"{run}: no object could be measured; run slimsfm benchmark again")
    written = write_figures(measured, output, format, overwrite=overwrite, progress=shown)
    for warning in written.warnings:
        console.print(warning, style="yellow")
    print_map_warnings(measured.objects)
    for path, explanation in written.files.items():
        console.print(f"{path}  {explanation}")
    finish(f"{output}: {len(written.files)} figures", watch, "report", run, "-o", "report.html")
