"""`slimsfm import`."""

from typing import Annotated

from slimsfm.cli.arguments import Reading
from slimsfm.cli.options import Advanced, ModelPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish_map
from slimsfm.mapping.importing import ImportOptions, import_colmap
from slimsfm.mapping.io import write_map
from slimsfm.mapping.space import bytes_to_import
from slimsfm.progress import shown


def import_(
    model: ModelPath,
    /,
    output: OutputPath,
    source: ImportOptions = ImportOptions(),
    reading: Annotated[Reading, Advanced()] = Reading(),
    overwrite: bool = False,
) -> None:
    """Make a map from a COLMAP model and the descriptors of its keypoints.

    Args:
        model: Folder with cameras, images and points3D, as .bin or .txt.
        output: Folder of the map.
        source: Where the descriptors come from.
        reading: Limits on what is read.
        overwrite: Replace an existing map.
    """
    watch = Stopwatch()
    reading.apply()
    needed = bytes_to_import(model)
    check_output(output, model, *source.paths(model), overwrite=overwrite, least_bytes=needed)
    made = import_colmap(model, options=source, progress=shown)
    write_map(made, output, overwrite=overwrite)
    console.print(f"box {made.info.box_source}, diagonal {made.box.diagonal:.3g} map units")
    finish_map(made, output, watch)
