"""Write a map to which photos were added, with the reference graphs of the map before."""

import shutil
from pathlib import Path

from slimsfm.execution import OpenExecutor
from slimsfm.files import replacing
from slimsfm.mapping.io import write_map
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.add import Addition
from slimsfm.upkeep.graphs import carry_graphs


def write_addition(
    addition: Addition,
    map: Map,
    source: Path,
    output: Path,
    *,
    overwrite: bool = False,
    open_executor: OpenExecutor | None = None,
    progress: ProgressBar = silent,
) -> None:
    """Write a map after photos were added to it.

    Where nothing was added, the files are copied as they are. Otherwise the reference graphs of the map are
    extended, unless old images moved.

    Args:
        addition: What was added.
        map: The map before.
        source: Its folder.
        output: Where to write the larger map.
        overwrite: Replace an existing output.
        open_executor: Opens the executor for the graphs; None: this process.
        progress: Progress callback.

    Raises:
        OutputError: The output exists and `overwrite` is off, or it cannot be written.
    """
    if not addition.added:
        with replacing(output, overwrite=overwrite) as partial:
            shutil.copytree(source, partial, ignore=shutil.ignore_patterns("*.partial"))
        return
    write_map(addition.map, output, overwrite=overwrite)
    if addition.movement is None:
        carry_graphs(map, source, output, open_executor=open_executor, progress=progress)
