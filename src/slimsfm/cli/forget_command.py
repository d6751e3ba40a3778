"""`slimsfm forget`."""

from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Execution
from slimsfm.cli.options import Advanced, Flags, MapPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish, finish_map, plural
from slimsfm.cli.tables import kept_graph
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.graph import GraphOptions
from slimsfm.mapping.io import read_map, write_map
from slimsfm.progress import shown
from slimsfm.upkeep.add import check_extendable
from slimsfm.upkeep.forget import ForgetOptions, Forgetting, forget


def forget_of(
    map: MapPath,
    /,
    output: Annotated[Path | None, Flags(("-o", "--output"))] = None,
    forgetting: ForgetOptions = ForgetOptions(),
    execution: Annotated[Execution, Advanced()] = Execution(),
    overwrite: bool = False,
) -> None:
    """Say what a map can forget and what that costs, and do it if an output is given.

    Points are forgotten that at least three images miss although others see them from nearly the same place,
    and images beyond a largest number, those first that others replace. Nothing else moves.

    Args:
        map: The full map.
        output: Where to write the map without it. Without this, nothing is written.
        forgetting: What to forget.
        execution: Where the reference graph is computed.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    if output:
        check_output(output, map, overwrite=overwrite)
    full = read_map(map)
    check_extendable(full, map)
    most = forgetting.max_images
    needs_graph = most is not None and most < len(full.images)
    graph = kept_graph(map, execution)(full, GraphOptions()) if needs_graph else None
    found = forget(full, forgetting, graph=graph, progress=shown)
    _print(found)
    if output:
        write_map(found.map, output, overwrite=overwrite)
        finish_map(found.map, output, watch)
    else:
        finish(f"{map}: nothing was written; to forget this, give an output with -o", watch)


def _print(found: Forgetting) -> None:
    points = plural(len(found.missed_points), "point")
    console.print(f"{points} that images which should see them never match")
    if found.images:
        orphans = plural(found.orphaned_points, "point")
        console.print(
            f"{plural(len(found.images), 'image')} that others replace, with {orphans} that only "
            f"they see: {', '.join(found.images)}"
        )
    whose = "forgotten images" if found.images else "images left out"
    console.print(
        f"cost: {found.before:.0f} % of {len(found.tests)} {whose} are localized to {ADD_FRACTIONS[0]:g}d "
        f"before, {found.after:.0f} % after"
    )
