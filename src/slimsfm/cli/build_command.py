"""`slimsfm build`."""

from collections.abc import Sequence
from typing import Annotated

from slimsfm.cli.networks import Networks
from slimsfm.cli.output import (
    Flat,
    ImagesPath,
    OutputPath,
    Stopwatch,
    check_output,
    console,
    finish_map,
    parse,
)
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.io import write_map
from slimsfm.progress import shown


def build_photos(
    images: ImagesPath,
    /,
    output: OutputPath,
    build: Annotated[BuildOptions, Flat] = BuildOptions(),
    networks: Annotated[Networks, Flat] = Networks(),
    overwrite: bool = False,
) -> None:
    """Build a map from a folder of photos.

    Args:
        images: Folder of photos, with those in its subfolders.
        output: Where the map is written.
        build: How to build.
        networks: Where learned methods run.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    networks.apply()
    check_output(output, images, overwrite=overwrite)
    made = build_map(images, build, progress=shown)
    write_map(made, output, overwrite=overwrite)
    if made.unregistered:
        names = ", ".join(made.unregistered)
        console.print(f"{len(made.unregistered)} photos could not be registered: {names}", style="yellow")
    console.print(f"box {made.info.box_source}, diagonal {made.box.diagonal:.3g} ({made.info.unit} unit)")
    finish_map(made, output, watch)


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    parse(build_photos, arguments)
