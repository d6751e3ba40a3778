"""`slimsfm synthesize`."""

from collections.abc import Sequence
from typing import Annotated

from slimsfm.cli.output import Flat, OutputPath, Stopwatch, finish, parse
from slimsfm.datasets.synthetic import SynthesisOptions, synthesize
from slimsfm.execution import num_cores, processes
from slimsfm.progress import shown


def synthesize_objects(
    output: OutputPath,
    synthesis: Annotated[SynthesisOptions, Flat] = SynthesisOptions(),
    overwrite: bool = False,
) -> None:
    """Render textured objects with exact ground truth, in OnePose's directory layout.

    Args:
        output: Folder that gets a folder an object.
        synthesis: What to render.
        overwrite: Replace objects that are there.
    """
    watch = Stopwatch()
    with processes(num_cores()) as executor:
        made = synthesize(output, synthesis, overwrite=overwrite, progress=shown, executor=executor)
    frames = sum(len(one.mapping.image_paths) + len(one.query.image_paths) for one in made)
    first = made[0].name
    what = f"{output}: {len(made)} objects, {frames} frames with exact poses"
    finish(what, watch, "build", output / first / f"{first}-1" / "color_full", "-o MAP")


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    parse(synthesize_objects, arguments)
