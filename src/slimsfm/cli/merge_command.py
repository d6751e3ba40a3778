"""`slimsfm merge`."""

from pathlib import Path

from slimsfm.cli.options import MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish_map, plural
from slimsfm.mapping.io import read_map, write_map
from slimsfm.progress import shown
from slimsfm.upkeep.merge import Merged, merge


def merge_maps(
    first: MapPath,
    second: MapPath,
    /,
    output: OutputPath,
    refine: bool = False,
    overwrite: bool = False,
) -> None:
    """Merge two maps of one place that overlap.

    The frame is that of the first map, unless only the second one knows its unit or its place on Earth. Its
    poses and points stay as they are, and the other map is moved into it. Points that both see are joined.
    Maps that do not overlap, or contradict each other, are refused.

    Args:
        first: A full map.
        second: Another one, with the same features.
        output: Folder of the merged map.
        refine: Adjust all poses, points and cameras together, and say how far images moved.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    check_output(output, first, second, overwrite=overwrite)
    maps = read_map(first), read_map(second)
    found = merge(*maps, refine=refine, progress=shown)
    write_map(found.map, output, overwrite=overwrite)
    _print(found, (first, second))
    finish_map(found.map, output, watch)


def _print(found: Merged, paths: tuple[Path, Path]) -> None:
    """Print what the merged map rests on."""
    kept, moved = paths[found.kept], paths[1 - found.kept]
    similarity = found.similarity
    agreeing, total = int(similarity.is_inlier.sum()), len(similarity.pairs.names)
    console.print(
        f"{moved} moved into the frame of {kept} by {agreeing} of {total} {similarity.pairs.how}: scale "
        f"{similarity.target_from_source.scale:.4g} ± {100 * similarity.scale_bound:.2g} %, rotation ± "
        f"{similarity.turn_bound_deg:.2g}°"
    )
    joined = plural(found.joined_points, "point")
    console.print(f"{plural(len(found.shared), 'photo')} in both maps; {joined} joined")
    renamed = [name for name, new in found.names.items() if new not in found.shared and new != name]
    if renamed:
        example = found.names[renamed[0]]
        console.print(
            f"{plural(len(renamed), 'image')} of {moved} renamed, such as {example}", style="yellow"
        )
    if found.movement:
        console.print(
            f"refined: images of {kept} moved by {found.movement.median:.2g}d (median), at most "
            f"{found.movement.largest:.2g}d ({found.movement.image})"
        )
