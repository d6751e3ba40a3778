"""`slimsfm build`."""

from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Execution, Networks, Reading
from slimsfm.cli.options import Advanced, Argument, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish_map, plural
from slimsfm.files.resumable import resumable_folder
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.inputs import InputOptions
from slimsfm.mapping.io import write_map
from slimsfm.mapping.space import bytes_to_build
from slimsfm.progress import shown

SourcePaths = Annotated[tuple[Path, ...], Argument("IMAGES")]


def build_photos(
    images: SourcePaths,
    /,
    output: OutputPath,
    inputs: InputOptions = InputOptions(),
    build: Annotated[BuildOptions, Advanced(("masks", "alpha", "max_image_size", "max_features", "seed"))] = (
        BuildOptions()
    ),
    execution: Annotated[Execution, Advanced()] = Execution(),
    networks: Annotated[Networks, Advanced()] = Networks(),
    reading: Annotated[Reading, Advanced()] = Reading(),
    overwrite: bool = False,
) -> None:
    """Build a map from photos and videos.

    Args:
        images: Folders of photos, subfolders included, and videos.
        output: Folder of the map.
        inputs: Frames of videos, and known poses.
        build: How to build the map.
        execution: Where features are extracted and matched.
        networks: Where learned methods run.
        reading: Limits on what is read.
        overwrite: Replace an existing map.
    """
    watch = Stopwatch()
    networks.apply()
    reading.apply()
    needed = bytes_to_build(images, build)
    sources = (*images, build.masks, build.box, inputs.poses)
    check_output(output, *sources, overwrite=overwrite, least_bytes=needed)
    with resumable_folder(output) as workspace:
        made = build_map(
            images,
            build,
            inputs=inputs,
            workspace=workspace,
            open_executor=execution.open_executor(),
            progress=shown,
        )
        write_map(made, output, overwrite=overwrite)
    if made.unregistered:
        names = ", ".join(made.unregistered)
        console.print(f"{len(made.unregistered)} photos could not be registered: {names}", style="yellow")
    if turned := made.info.exif_orientations:
        text = f"{plural(len(turned), 'photo')} turned upright by EXIF"
        console.print(f"{text}; for COLMAP, `slimsfm export colmap` turns the model back", style="dim")
    console.print(f"box {made.info.box_source}, diagonal {made.box.diagonal:.3g} ({made.info.unit} unit)")
    finish_map(made, output, watch)
