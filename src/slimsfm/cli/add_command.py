"""`slimsfm add`."""

from typing import Annotated

from slimsfm.cli.arguments import Execution, Networks, Reading
from slimsfm.cli.options import Advanced, ImagesPath, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish_map, plural
from slimsfm.files.resumable import resumable_folder
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from slimsfm.progress import shown
from slimsfm.reduction import predict_growth
from slimsfm.upkeep.add import Addition, AddOptions, add, check_extendable
from slimsfm.upkeep.writing import write_addition


def add_photos(
    map: MapPath,
    images: ImagesPath,
    /,
    output: OutputPath,
    adding: Annotated[AddOptions, Advanced(("matcher", "seed"))] = AddOptions(),
    execution: Annotated[Execution, Advanced()] = Execution(),
    networks: Annotated[Networks, Advanced()] = Networks(),
    reading: Annotated[Reading, Advanced()] = Reading(),
    overwrite: bool = False,
) -> None:
    """Add photos to a map, without moving what it has.

    Photos are localized, matched with their likely neighbors, triangulated and adjusted. Those that are not
    sure are tried again when similar ones entered, and listed if they never are. Reference graphs of the map
    are extended. Photos that are in the map already do not count.

    Args:
        map: The full map.
        images: Folder of new photos, or one photo.
        output: Folder of the larger map.
        adding: How to add.
        execution: Where features are extracted and matched.
        networks: Where learned methods run.
        reading: Limits on what is read.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    networks.apply()
    reading.apply()
    check_output(output, map, images, overwrite=overwrite)
    before = read_map(map)
    check_extendable(before, map)
    with resumable_folder(output) as workspace:
        found = add(
            before,
            images,
            adding,
            workspace=workspace,
            open_executor=execution.open_executor(),
            progress=shown,
        )
        write_addition(
            found,
            before,
            map,
            output,
            overwrite=overwrite,
            open_executor=execution.open_executor(),
            progress=shown,
        )
    _print(before, found)
    finish_map(found.map, output, watch)


def _print(before: Map, found: Addition) -> None:
    """Print what was added, what was not and why, and what was gained."""
    for note in found.notes:
        if note not in found.map.info.notes:
            console.print(f"note: {note}", style="yellow")
    if found.known:
        console.print(f"{plural(len(found.known), 'photo')} in the map already")
    for name, reason in found.left_out.items():
        console.print(f"not added: {name}: {reason}", style="yellow")
    if not found.added:
        console.print("nothing new: the map is unchanged")
        return
    console.print(f"{plural(len(found.added), 'photo')} added in {plural(found.rounds, 'round')}")
    if found.movement:
        moved = found.movement
        console.print(
            f"refined: old images moved by {moved.median:.2g}d (median), at most {moved.largest:.2g}d "
            f"({moved.image})"
        )
    old, new = found.before, found.after
    console.print(
        f"coverage: {_more(old.points, new.points)} points, {_more(old.surface, new.surface)} cells of the "
        f"surface (a 32nd of the diagonal each), {_more(old.views, new.views)} views of them"
    )
    growth = predict_growth(found.map, before.images, shown)
    console.print(
        f"forecast: {growth.before:.0f} % of {plural(len(growth.tests), 'image')} left out are localized to "
        f"{ADD_FRACTIONS[0]:g}d by the old images, {growth.after:.0f} % by all; queries lost: "
        f"{', '.join(growth.lost) or 'none'}"
    )


def _more(before: int, after: int) -> str:
    return f"{before} -> {after} ({100 * (after / max(before, 1) - 1):+.0f} %)"
