"""`slimsfm localize`."""

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Networks, Reading
from slimsfm.cli.options import Advanced, ImagesPath, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish, plural
from slimsfm.cli.parsing import with_flags
from slimsfm.errors import InputError
from slimsfm.image_files import find_images
from slimsfm.localization import (
    Localization,
    LocalizationOptions,
    Localizer,
    MultiLocalizer,
    check_same_frame,
    localize_failed,
    localize_images,
    localize_objects,
)
from slimsfm.localization.cameras import read_camera, read_gravity
from slimsfm.localization.pose_files import check_names_for, write_object_poses, write_poses, writer_for
from slimsfm.mapping.io import read_map
from slimsfm.progress import shown


def localize(
    map: MapPath,
    images: ImagesPath,
    /,
    output: OutputPath,
    also: tuple[Path, ...] = (),
    full: Path | None = None,
    localization: Annotated[LocalizationOptions, Advanced(("matching", "ransac"))] = LocalizationOptions(),
    networks: Annotated[Networks, Advanced()] = Networks(),
    reading: Annotated[Reading, Advanced()] = Reading(),
    camera: Path | None = None,
    gravity: Path | None = None,
    workers: int | None = None,
    strict: bool = False,
    overwrite: bool = False,
) -> None:
    """Estimate the camera poses of images.

    Args:
        map: A map.
        images: A folder of images, or one image.
        output: Poses as .json, .csv, .txt (TUM) or images.txt (COLMAP).
        also: Maps of further objects to find in the same images. Poses are then written as .json or .csv.
        full: The full map that the map was reduced from, for images that the reduced one gives no pose.
        localization: How to localize.
        networks: Where learned methods run.
        reading: Limits on what is read.
        camera: Intrinsics of the images in COLMAP's cameras.txt format. Without it, those of the map where
            size and EXIF fit, else from EXIF; else the focal length is estimated.
        gravity: Direction of gravity as JSON: {"world": [x, y, z], "images": {NAME: [x, y, z]}}, in the frame
            of the map and in the camera frames of the images.
        workers: Number of images to localize at a time, by default the number of cores.
        strict: Stop at the first image that cannot be used, instead of skipping it.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    networks.apply()
    reading.apply()
    check_output(output, map, images, *also, full, camera, gravity, overwrite=overwrite)
    writer_for(output, several=bool(also))
    _check_options(workers, also, gravity=gravity, full=full)
    localizers = {name: Localizer(read_map(path), localization) for name, path in _named(map, *also).items()}
    check_names_for(output, [images.name] if images.is_file() else find_images(images).names)
    camera_of_all = read_camera(camera) if camera else None
    shared = {"camera": camera_of_all, "workers": workers, "progress": shown}
    again: dict[str, Localization] = {}
    if also:
        by_object = localize_objects(MultiLocalizer(localizers), images, strict=strict, **shared)
        infos = {name: one.map.info for name, one in localizers.items()}
        write_object_poses(output, by_object, infos=infos, overwrite=overwrite)
    else:
        ((name, only),) = localizers.items()
        shared["gravity"] = read_gravity(gravity) if gravity else None
        fallback = _full_map(full, only) if full else None
        results = localize_images(only, images, strict=strict, **shared)
        again = localize_failed(fallback, results, images, **shared) if fallback else {}
        by_object = {name: {**results, **again}}
        write_poses(output, by_object[name], info=only.map.info, overwrite=overwrite)
    found = _print(by_object, again)
    if again:
        saved = sum(one.pose is not None for one in again.values())
        console.print(f"{full}: gave {saved} of the {plural(len(again), 'pose')} that {map} did not")
    first = next(iter(by_object.values()))
    skipped = sum(one.is_skipped for one in first.values())
    left_out = f", {skipped} skipped" if skipped else ""
    finish(f"{output}: {found} of {plural(len(first), 'image')} localized{left_out}", watch)


def _check_options(workers: int | None, also: Collection[Path], **of_one_map: Path | None) -> None:
    if workers is not None and workers < 1:
        raise InputError(f"workers must be at least 1, got {workers}")
    for name, value in of_one_map.items():
        if value and also:
            raise InputError(f"{name} goes with one map; leave out also or {name}")


def _named(*paths: Path) -> dict[str, Path]:
    """Map paths by their last part, or by the whole path where these parts are equal."""
    last = [Path(os.path.realpath(path)).name for path in paths]
    names = last if len(set(last)) == len(last) else [str(path) for path in paths]
    if len(set(names)) < len(names):
        raise InputError(f"also: the map {max(names, key=names.count)} is given twice")
    return dict(zip(names, paths, strict=True))


def _full_map(path: Path, reduced: Localizer) -> Localizer:
    """The localizer of the full map that a map was reduced from."""
    found = read_map(path)
    check_same_frame(reduced.map, found)
    return Localizer(found, reduced.options)


def _print(by_object: Mapping[str, Mapping[str, Localization]], again: Collection[str]) -> int:
    """Print the outcome of each image and the mean times; return how many were localized in any map."""
    images = list(next(iter(by_object.values())))
    every = (one for results in by_object.values() for one in results.values())
    for note in dict.fromkeys(note for one in every for note in one.camera_notes):
        console.print(f"note: {note}", style="yellow")
    for image in images:
        for key, results in by_object.items():
            name = f"{image}, {key}" if len(by_object) > 1 else image
            console.print(
                f"{name}: {_outcome(results[image])}{', full map' * (image in again)}",
                style=None if results[image].pose else "yellow",
            )
    searched = [one for results in by_object.values() for one in results.values() if not one.is_skipped]
    queries = len(searched) / len(by_object)
    times = {
        stage: 1e3 * sum(getattr(one.seconds, stage) for one in searched) / queries
        for stage in ("extract", "match", "pose")
    }
    console.print("per query: " + ", ".join(f"{stage} {ms:.1f} ms" for stage, ms in times.items()))
    return sum(any(results[image].pose for results in by_object.values()) for image in images)


def _outcome(one: Localization) -> str:
    if one.pose is None:
        return f"{'skipped' if one.is_skipped else 'not localized'}: {with_flags(one.reason or '')}"
    inliers = f"{one.pose.num_inliers} inliers of {one.num_matches} matches"
    return f"{inliers}, confidence {one.pose.confidence:.2f}{_estimated(one)}"


_DO_NOT_FIT = {
    "given": ", because those given do not fit",
    "map": ", because those of the map's camera do not fit",
    "queries": ", because those of the other images do not fit",
}


def _estimated(one: Localization) -> str:
    """Which intrinsics were estimated, and why."""
    if not one.camera_estimated:
        return ""
    return f", {' and '.join(one.camera_estimated)} estimated{_DO_NOT_FIT.get(one.camera_source, '')}"
