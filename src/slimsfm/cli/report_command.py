"""`slimsfm report`."""

from pathlib import Path
from typing import Annotated

from slimsfm.cli.options import Argument, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, finish
from slimsfm.cli.tables import print_map_warnings
from slimsfm.errors import InputError
from slimsfm.evaluation.result_files import read_run


def report(
    run: Annotated[Path, Argument("RUN")],
    /,
    output: OutputPath,
    overwrite: bool = False,
) -> None:
    """Show a run of `slimsfm benchmark` on one HTML page: what was kept, what it costs, where it fails.

    The page needs no network and no other file.

    Args:
        run: Folder of a run, with its maps.
        output: The HTML file.
        overwrite: Replace an existing page.
    """
    from slimsfm.report import write_report  # imports matplotlib

    watch = Stopwatch()
    check_output(output, overwrite=overwrite)
    measured = read_run(run)
    if not measured.objects:
        raise InputError(f"{run}: no object could be measured; run slimsfm benchmark again")
    write_report(output, measured, overwrite=overwrite)
    print_map_warnings(measured.objects)
    finish(str(output), watch)
