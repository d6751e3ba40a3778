"""`slimsfm synthesize`."""

from slimsfm.cli.options import OutputPath
from slimsfm.cli.output import Stopwatch, finish, plural
from slimsfm.datasets.synthetic import SynthesisOptions, synthesize
from slimsfm.execution import num_cores, processes
from slimsfm.files.space import check_place
from slimsfm.progress import shown


def synthesize_objects(
    output: OutputPath,
    synthesis: SynthesisOptions = SynthesisOptions(),
    overwrite: bool = False,
) -> None:
    """Render textured objects with exact ground truth in OnePose's directory layout.

    Args:
        output: The output folder, with one subfolder per object.
        synthesis: What to render.
        overwrite: Replace existing objects.
    """
    watch = Stopwatch()
    check_place(output)
    with processes(num_cores()) as executor:
        made = synthesize(output, synthesis, overwrite=overwrite, progress=shown, executor=executor)
    frames = sum(len(one.mapping.image_paths) + len(one.query.image_paths) for one in made)
    first = made[0].name
    what = f"{output}: {plural(len(made), 'object')}, {frames} frames with exact poses"
    finish(what, watch, "build", output / first / f"{first}-1" / "color_full", "-o MAP")
