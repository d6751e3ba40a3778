"""How exact a map from known poses is: localize every third photo in a map of the others.

The folder has a `transforms.json` and the photos that it names. Sorted by name, every third photo, starting
with the first, is a query. Errors are distances to the given poses, in the unit of the file.

    python benchmarks/known_poses.py FOLDER
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from slimsfm import InputOptions, Localizer, build_map, localize_images
from slimsfm.execution import processes
from slimsfm.geometry import rotation_error_deg
from slimsfm.image_files import find_images
from slimsfm.mapping.known_poses import read_given
from slimsfm.mapping.known_poses.matching import PhotosToPose, match_photos


def center(pose: pycolmap.Rigid3d) -> np.ndarray:
    """Where a camera stands."""
    return pose.inverse().translation


def split(folder: Path, names: list[str], place: Path) -> tuple[Path, Path]:
    """Folders with links to the references and to the queries."""
    folders = place / "references", place / "queries"
    for row, name in enumerate(names):
        link = folders[row % 3 == 0] / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to((folder / name).resolve())
    return folders


def measure(folder: Path, place: Path, workers: int, *, refine: bool) -> str:
    """Build the map, localize the queries, and give a row of the table."""
    names = sorted(find_images(folder).names)
    given = read_given(folder)
    keys = match_photos(given, PhotosToPose(folder=folder, names=names, seconds={}))
    references, queries = split(folder, sorted(keys), place)
    executor = None if workers == 1 else lambda: processes(workers)
    inputs = InputOptions(poses=folder, refine=refine)
    made = build_map(references, inputs=inputs, open_executor=executor)
    found = localize_images(Localizer(made), queries, workers=workers)
    errors = []
    for name, one in found.items():
        truth = given.cam_from_world[keys[name]]
        if one.pose is None:
            errors.append((np.inf, np.inf))
            continue
        pose = one.pose.cam_from_world
        errors.append((np.linalg.norm(center(pose) - center(truth)), rotation_error_deg(pose, truth)))
    moved, turned = np.array(errors).T
    within = np.mean((moved <= 0.05) & (turned <= 5))
    notes = next((note for note in made.info.notes if note.startswith("poses adjusted")), "")
    return (
        f"| {'refined' if refine else 'as they are'} | {made.info.unit} | {len(errors)} | "
        f"{np.median(moved):.4f} | {np.median(turned):.2f}° | {within:.1%} | {notes} |"
    )


def main() -> None:
    """Measure a folder, without and with refinement."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    print("| poses | unit | queries | median distance | median angle | within 0.05 and 5° | |")
    print("|---|---|---|---|---|---|---|")
    for refine in (False, True):
        with TemporaryDirectory() as place:
            print(measure(options.folder, Path(place), options.workers, refine=refine), flush=True)


if __name__ == "__main__":
    main()
