"""`slimsfm check`."""

import json as json_format
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import pycolmap

from slimsfm.cli.options import Flags, MapPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish, plural
from slimsfm.errors import InputError
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.progress import shown
from slimsfm.upkeep.checking import check as check_map
from slimsfm.upkeep.findings import MapCheck, WrongPose
from slimsfm.upkeep.repair import Repaired
from slimsfm.upkeep.repair import repair as repair_map

EXIT_FOUND = 1
"""Exit code if poses are wrong, as linters have it for what they find."""

_SERIOUS = "wrong poses", "misplaced", "contradicted pairs", "threads"


def check(
    map: MapPath,
    /,
    output: Annotated[Path | None, Flags(("-o", "--output"))] = None,
    repair: bool = False,
    images: Path | None = None,
    figure: Path | None = None,
    json: bool = False,
    overwrite: bool = False,
) -> int:
    """Find images whose poses are wrong, and parts and images that little supports.

    Each image is localized from the others, by points that do not depend on it. The exit code is 1 if the
    others contradict poses, and with `--repair` if something else contradicts the map; 0 if nothing does.

    Args:
        map: A full map.
        output: Write a copy of the map here in which wrong poses are marked, so that `reduce` leaves them
            out of account. With `--repair`, the repaired map.
        repair: Register images with wrong poses again where the others say that they stand, or drop them.
        images: Folder of the photos; blur is then judged by their pixels instead of the keypoints.
        figure: Draw the cameras from above, wrong ones in red, as .svg, .png or .pdf.
        json: Print JSON for programs.
        overwrite: Replace existing files.
    """
    watch = Stopwatch()
    if repair and output is None:
        raise InputError("--repair makes a map: give its folder with --output")
    _check_outputs(map, output, figure, overwrite=overwrite)
    map_ = read_map(map)
    found = check_map(map_, images=images, progress=shown)
    repaired = repair_map(map_, found, progress=shown) if repair else None
    if figure:
        from slimsfm.report.checked_map import check_picture
        from slimsfm.report.figures import save_figure

        save_figure(check_picture(map_, found), figure, overwrite=overwrite)
    if output:
        write_map(repaired.map if repaired else _marked(map_, found), output, overwrite=overwrite)
    if json:
        print(json_format.dumps(_facts(found, repaired), indent=2))
    else:
        _print(found, repaired, output, watch)
    left = found.contradicted_pairs if repair else found.is_contradicted
    return EXIT_FOUND if left else 0


def _check_outputs(map: Path, output: Path | None, figure: Path | None, *, overwrite: bool) -> None:
    if output:
        check_output(output, map, overwrite=overwrite)
    if figure:
        from slimsfm.report.figures import check_figure

        check_figure(figure)
        check_output(figure, map, overwrite=overwrite)


def _marked(map: Map, found: MapCheck) -> Map:
    return replace(map, info=replace(map.info, wrong_poses=found.wrong_names))


def _print(found: MapCheck, repaired: Repaired | None, output: Path | None, watch: Stopwatch) -> None:
    again = " (matched again: the map stores none)" if found.matches_from != "map" else ""
    agree = f"{found.agreeing_pairs} of {plural(found.pairs, 'pair')} agree with the map"
    console.print(f"{plural(found.images, 'image')}; {agree}{again}")
    if 2 * found.agreeing_pairs < found.pairs:
        console.print("warning: most pairs contradict the map: all of it may be wrong", style="bold red")
    console.print(
        f"the others localize an image {found.usual_error:.2g} d from its pose in the map (median), where "
        "d is the diagonal of the box"
    )
    for title, findings in _sections(found).items():
        style = "bold red" if title in _SERIOUS else "yellow"
        console.print(f"{title}: {len(findings) or 'none'}", style=style if findings else "")
        for one in findings:
            console.print(f"  {one.sentence}")
    if repaired:
        for title, names in (("set right", repaired.moved), ("dropped", repaired.dropped)):
            console.print(f"{title}: {', '.join(names) or 'none'}")
    wrong = plural(len(found.wrong_names), "wrong pose")
    finish(f"{f'{output}: ' if output else ''}checked, {wrong}", watch)


def _sections(found: MapCheck) -> dict[str, Sequence[Any]]:
    return {
        "wrong poses": found.wrong,
        "misplaced": found.misplaced,
        "contradicted pairs": found.contradicted_pairs,
        "not localized by any others": found.unlocalized,
        "threads": found.threads,
        "duplicates": found.duplicates,
        "blurred": found.blurred,
    }


def _facts(found: MapCheck, repaired: Repaired | None) -> dict[str, Any]:
    return {
        "images": found.images,
        "pairs": found.pairs,
        "agreeing_pairs": found.agreeing_pairs,
        "matches_from": found.matches_from,
        "usual_error": found.usual_error,
        "wrong": [_wrong(one) for one in found.wrong],
        "misplaced": [asdict(one) for one in found.misplaced],
        "contradicted_pairs": [asdict(one) for one in found.contradicted_pairs],
        "unlocalized": [asdict(one) for one in found.unlocalized],
        "threads": [asdict(one) for one in found.threads],
        "duplicates": [asdict(one) for one in found.duplicates],
        "blurred": [asdict(one) for one in found.blurred],
        "repaired": repaired and {"moved": list(repaired.moved), "dropped": list(repaired.dropped)},
    }


def _wrong(one: WrongPose) -> dict[str, Any]:
    return {
        "name": one.name,
        "relative_corner_error": one.distance,
        "predicted_error": one.predicted_error,
        "rotation_deg": one.rotation_deg,
        "shift": one.shift,
        "inliers": one.inliers,
        "agreeing": one.agreeing,
        "sets": [list(some) for some in one.sets],
        "cam_from_world": _pose(one.cam_from_world),
        "others_cam_from_world": _pose(one.others_cam_from_world),
    }


def _pose(cam_from_world: pycolmap.Rigid3d) -> dict[str, list[float]]:
    return {
        "quaternion_xyzw": cam_from_world.rotation.quat.tolist(),
        "translation": cam_from_world.translation.tolist(),
    }
