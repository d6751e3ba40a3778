"""`slimsfm localize`."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import pycolmap

from slimsfm.cli.networks import Networks
from slimsfm.cli.options import Advanced, ImagesPath, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish, plural
from slimsfm.errors import InputError
from slimsfm.execution import map_on_threads, num_cores
from slimsfm.localization import Localization, LocalizationOptions, Localizer, MultiLocalizer
from slimsfm.localization.cameras import (
    FocalLength,
    UnknownIntrinsicsError,
    query_camera,
    read_camera,
    read_gravity,
)
from slimsfm.localization.pose_files import write_object_poses, write_poses, writer_for
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from slimsfm.photos import list_images, read_image
from slimsfm.pose import Gravity
from slimsfm.progress import shown

Found = dict[str, Localization]
"""The outcome of each object in one image."""


def localize(
    map: MapPath,
    images: ImagesPath,
    /,
    output: OutputPath,
    also: tuple[Path, ...] = (),
    localization: Annotated[LocalizationOptions, Advanced(("matching", "ransac"))] = LocalizationOptions(),
    networks: Annotated[Networks, Advanced()] = Networks(),
    camera: Path | None = None,
    gravity: Path | None = None,
    workers: int | None = None,
    overwrite: bool = False,
) -> None:
    """Estimate the camera poses of images.

    Args:
        map: A map.
        images: A folder of images, or one image.
        output: Poses as .json, .csv, .txt (TUM) or images.txt (COLMAP).
        also: Maps of further objects to find in the same images. Poses are then written as .json or .csv.
        localization: How to localize.
        networks: Where learned methods run.
        camera: Intrinsics of the images in COLMAP's cameras.txt format. Without it, those of the map or from
            EXIF are used.
        gravity: Direction of gravity as JSON: {"world": [x, y, z], "images": {NAME: [x, y, z]}}, in the frame
            of the map and in the camera frames of the images.
        workers: Number of images to localize at a time, by default the number of cores.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    networks.apply()
    for source in (map, images, *also):
        check_output(output, source, overwrite=overwrite)
    writer_for(output, several=bool(also))
    if workers is not None and workers < 1:
        raise InputError(f"workers must be at least 1, got {workers}")
    maps = {name: read_map(path) for name, path in _named(map, *also).items()}
    given = read_camera(camera) if camera else None
    if gravity and (also or localization.focal != "known"):
        raise InputError("gravity goes with one map and a known focal length; leave out also or focal")
    try:
        queries = _queries(maps, images, given, localization.focal)
    except UnknownIntrinsicsError as error:
        raise InputError(f"{error} (--camera FILE, --focal unknown)") from error
    downwards = read_gravity(gravity) if gravity else {}
    localizers = {name: Localizer(one, localization) for name, one in maps.items()}
    work = partial(_localize, MultiLocalizer(localizers), downwards)
    run = map_on_threads(work, queries, workers or num_cores())
    label = f"localize ({', '.join(sorted({localization.strategy_for(one) for one in maps.values()}))})"
    results = {query.name: next(run) for query in shown(queries, label)}
    by_object = {name: {image: one[name] for image, one in results.items()} for name in maps}
    if also:
        write_object_poses(output, by_object, overwrite=overwrite)
    else:
        write_poses(output, next(iter(by_object.values())), overwrite=overwrite)
    _print(results, several=bool(also))
    found = sum(any(one.pose for one in of_image.values()) for of_image in results.values())
    finish(f"{output}: {found} of {plural(len(results), 'image')} localized", watch)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Query:
    name: str
    path: Path
    cameras: Mapping[str, pycolmap.Camera]


def _named(*paths: Path) -> dict[str, Path]:
    """Map paths by their last part, or by the whole path where these parts are equal."""
    last = [path.resolve().name for path in paths]
    names = last if len(set(last)) == len(last) else [str(path) for path in paths]
    if len(set(names)) < len(names):
        raise InputError(f"also: the map {max(names, key=names.count)} is given twice")
    return dict(zip(names, paths, strict=True))


def _queries(
    maps: Mapping[str, Map], images: Path, given: pycolmap.Camera | None, focal: FocalLength
) -> list[_Query]:
    folder, names = (images.parent, [images.name]) if images.is_file() else (images, list_images(images))
    return [
        _Query(
            name=name,
            path=folder / name,
            cameras={key: query_camera(one, folder / name, given, focal) for key, one in maps.items()},
        )
        for name in names
    ]


def _localize(localizer: MultiLocalizer, downwards: Mapping[str, Gravity], query: _Query) -> Found:
    return localizer.localize(read_image(query.path), query.cameras, downwards.get(query.name))


def _print(results: Mapping[str, Found], *, several: bool) -> None:
    for image, found in results.items():
        for key, one in found.items():
            name = f"{image}, {key}" if several else image
            console.print(f"{name}: {_outcome(one)}", style=None if one.pose else "yellow")
    stages = ("extract", "match", "pose")
    times = dict.fromkeys(stages, 0.0)
    for one in (one for found in results.values() for one in found.values()):
        for stage in stages:
            times[stage] += 1e3 * getattr(one.seconds, stage) / len(results)
    console.print("per query: " + ", ".join(f"{stage} {ms:.1f} ms" for stage, ms in times.items()))


def _outcome(one: Localization) -> str:
    if one.pose is None:
        return "not localized"
    inliers = f"{one.pose.num_inliers} inliers of {one.num_matches} matches"
    return f"{inliers}, confidence {one.pose.confidence:.2f}"
