"""`slimsfm localize`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from slimsfm.cli.output import (
    Flat,
    ImagesPath,
    MapPath,
    OutputPath,
    Stopwatch,
    check_output,
    console,
    finish,
    parse,
)
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.cameras import query_camera, read_camera
from slimsfm.localization.pose_files import write_poses, writer_for
from slimsfm.mapping.io import read_map
from slimsfm.photos import list_images, read_image
from slimsfm.progress import shown


def localize(
    map: MapPath,
    images: ImagesPath,
    /,
    output: OutputPath,
    localization: Annotated[LocalizationOptions, Flat] = LocalizationOptions(),
    camera: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Find where images were taken.

    Args:
        map: A map.
        images: A folder of images, or one image.
        output: Poses as .json, .csv, .txt (TUM) or images.txt (COLMAP).
        localization: How to localize.
        camera: Intrinsics of the images, in COLMAP's cameras.txt format; else the map's or EXIF's.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    check_output(output, map, overwrite=overwrite)
    check_output(output, images, overwrite=overwrite)
    writer_for(output)
    given = read_camera(camera) if camera else None
    map_ = read_map(map)
    folder, names = (images.parent, [images.name]) if images.is_file() else (images, list_images(images))
    cameras = {name: query_camera(map_, folder / name, given) for name in names}
    localizer = Localizer(map_, localization)
    results = {
        name: localizer.localize(read_image(folder / name), cameras[name])
        for name in shown(names, f"localize ({localization.strategy_for(map_)})")
    }
    write_poses(output, results, overwrite=overwrite)
    for name, one in results.items():
        outcome = (
            f"{one.pose.num_inliers} inliers of {one.num_matches} matches" if one.pose else "not localized"
        )
        console.print(f"{name}: {outcome}", style=None if one.pose else "yellow")
    stages = ("extract", "match", "pose")
    times = [1e3 * np.mean([getattr(one.seconds, stage) for one in results.values()]) for stage in stages]
    console.print(
        "a query: " + ", ".join(f"{stage} {ms:.1f} ms" for stage, ms in zip(stages, times, strict=True))
    )
    found = sum(one.pose is not None for one in results.values())
    finish(f"{output}: {found} of {len(results)} images localized", watch, "info", map)


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    parse(localize, arguments)
