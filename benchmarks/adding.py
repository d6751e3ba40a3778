"""Add photos to a map of half of them, and compare with a map that is built from all at once.

    python benchmarks/adding.py FOLDER -o WORK [--truth MAP]

Every third photo by name, from the first, is a query and in no map. Of the others, every second makes the
first map; the rest is added in three portions, each with the photos that were left out before. Queries are
localized in the final map and in the map that is built from all of these photos at once. True poses are those
of `transforms.json` in the folder (as nerfstudio writes it), or else of a map of all photos, queries included
(`--truth`). Errors are over the diagonal of the box of the true model, after the frames were aligned by the
camera centers of the photos that both maps have. Times are those of the processor, all work in one process.
"""

import argparse
import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np
import pycolmap

from posed_scenes import read_transforms
from slimsfm.cli.output import quiet
from slimsfm.datasets.reconstructed import query_names
from slimsfm.errors import InputError
from slimsfm.geometry import ADD_FRACTIONS, Box, corner_error
from slimsfm.image_files import list_images
from slimsfm.localization import Localizer, localize_images
from slimsfm.mapping import KnownPoses, Map, build_map, read_map, write_map
from slimsfm.mapping.model import estimate_box
from slimsfm.progress import shown
from slimsfm.upkeep.add import add

_PORTIONS = 3


def linked(source: Path, names: Iterable[str], folder: Path) -> Path:
    """A folder with links to some photos of another one."""
    for name in names:
        link = folder / name
        link.parent.mkdir(parents=True, exist_ok=True)
        if not link.is_symlink():
            os.symlink((source / name).resolve(), link)
    return folder


def built(source: Path, names: list[str], work: Path, known: Path | None) -> tuple[Map, float]:
    """Build a map of some photos, and measure the time."""
    folder, start = linked(source, names, work / "photos"), process_time()
    poses = None
    if known:
        camera, all_poses = read_transforms(known)
        poses = KnownPoses(
            cameras=dict.fromkeys(names, camera),
            cam_from_world={name: all_poses[name] for name in names},
            box=Box(np.zeros(3), np.eye(3)),
            unit="metre",
        )
    with quiet():
        made = build_map(folder, known=poses, workspace=work / "build", progress=shown)
    if known:
        made = replace(made, info=replace(made.info, box=estimate_box(made.model), box_source="estimated"))
    write_map(made, work / "map", overwrite=True)
    return read_map(work / "map"), process_time() - start


def errors(map: Map, queries: Path, poses: dict[str, pycolmap.Rigid3d], box: Box) -> np.ndarray:
    """Relative corner error of each query of true pose; infinite without a pose."""
    common = sorted(map.images.keys() & poses.keys())
    here = np.array([map.images[name].projection_center() for name in common])
    there = np.array([poses[name].inverse().translation for name in common])
    true_from_map = pycolmap.estimate_sim3d(here, there)
    if true_from_map is None:
        raise SystemExit("the maps cannot be aligned")
    found = localize_images(Localizer(map), queries, progress=shown)
    return np.array(
        [
            np.inf
            if one.pose is None
            else corner_error(true_from_map.transform_camera_world(one.pose.cam_from_world), poses[name], box)
            for name, one in found.items()
            if name in poses
        ]
    )


def main() -> None:
    """Build, add, localize, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--truth", type=Path, help="map of all photos; without transforms.json")
    arguments = parser.parse_args()
    folder, work = arguments.folder, arguments.output
    known = folder / "transforms.json" if (folder / "transforms.json").is_file() else None
    names = sorted(read_transforms(known)[1]) if known else list_images(folder)
    queries = query_names(names, 3)
    references = [name for name in names if name not in queries]
    half, rest = references[::2], references[1::2]
    queries_folder = linked(folder, queries, work / "queries")

    at_once, all_seconds = built(folder, references, work / "all", known)
    first, half_seconds = built(folder, half, work / "half", known)
    grown, seconds, left_out = first, [], []
    for portion in range(_PORTIONS):
        place = work / f"portion{portion}"
        photos = linked(folder, [*rest[portion::_PORTIONS], *left_out], place / "photos")
        start = process_time()
        try:
            found = add(grown, photos, workspace=place / "add", progress=shown)
        except InputError as error:  # those that could be added may come with a later portion
            seconds.append(process_time() - start)
            left_out = [*left_out, *rest[portion::_PORTIONS]]
            print(error)
            continue
        write_map(found.map, place / "map", overwrite=True)
        seconds.append(process_time() - start)
        grown, left_out = read_map(place / "map"), list(found.left_out)
        print(f"portion {portion + 1}: {len(found.added)} added; not: {dict(found.left_out)}")
    added = sorted(grown.images.keys() - first.images.keys())
    again = add(grown, linked(folder, added, work / "again"))
    poses, box = true_poses(known, arguments.truth, at_once)
    moved = sum(
        not np.array_equal(image.cam_from_world().matrix(), grown.images[name].cam_from_world().matrix())
        for name, image in first.images.items()
    )
    print(
        f"\n| map of {folder.name} | images | CPU seconds | "
        + " | ".join(f"within {f:g} d" for f in ADD_FRACTIONS)
        + " | median |"
    )
    print("|---|---|---|" + "---|" * (len(ADD_FRACTIONS) + 1))
    for title, one, took in (
        ("half", first, half_seconds),
        ("half, then three portions", grown, sum(seconds)),
        ("all at once", at_once, all_seconds),
    ):
        measured = errors(one, queries_folder, poses, box)
        shares = " | ".join(f"{100 * np.mean(measured < f):.1f} %" for f in ADD_FRACTIONS)
        print(f"| {title} | {len(one.images)} | {took:.0f} | {shares} | {np.median(measured):.5f} d |")
    print(f"\nold poses that moved: {moved} of {len(first.images)}")
    print(f"CPU seconds of the portions: {', '.join(f'{one:.0f}' for one in seconds)}")
    print(f"the added photos again: {len(again.added)} added, {len(again.known)} known")


def true_poses(
    known: Path | None, truth: Path | None, fallback: Map
) -> tuple[dict[str, pycolmap.Rigid3d], Box]:
    """Poses by name, and the box that errors are measured by."""
    if known:
        return read_transforms(known)[1], fallback.box
    if truth is None:
        raise SystemExit("give --truth: a map of all photos")
    found = read_map(truth)
    return {name: image.cam_from_world() for name, image in found.images.items()}, found.box


if __name__ == "__main__":
    main()
