"""Map two overlapping halves of a place apart, merge them, and compare poses across them with a device's.

    python benchmarks/merging.py FOLDER -o WORK

The photos of `transforms.json` in FOLDER, in order of name, make two halves that overlap by a fifth of all.
In the first line of the table both halves have the photos of the overlap; in the others these alternate, so
that the maps have no photo in common. Each half is mapped on its own: with the device's poses, or from the
photos alone, in a frame and unit of its own. After merging, the pose of each photo of the second half
relative to each of the first is compared with the device's, in meters.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from adding import built
from posed_scenes import read_transforms
from slimsfm.errors import SlimsfmError
from slimsfm.geometry import rotation_error_deg
from slimsfm.mapping import Map
from slimsfm.progress import shown
from slimsfm.upkeep.merge import merge

OVERLAP = 0.2
"""Share of all photos in the overlap of the halves."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """How the halves are made."""

    title: str
    shares_photos: bool
    """Whether both maps have the photos of the overlap."""

    is_plain: bool
    """Whether the second half is mapped from its photos alone."""


CASES = (
    Case(title="device's poses, photos in common", shares_photos=True, is_plain=False),
    Case(title="device's poses, no photo in common", shares_photos=False, is_plain=False),
    Case(title="the second from its photos alone, no photo in common", shares_photos=False, is_plain=True),
)


def halves(names: list[str], *, shares_photos: bool) -> tuple[list[str], list[str]]:
    """The photos of two halves that overlap."""
    low, high = (round(len(names) * (0.5 + side * OVERLAP / 2)) for side in (-1, 1))
    overlap = names[low:high]
    if shares_photos:
        return names[:high], names[low:]
    return [*names[:low], *overlap[::2]], [*overlap[1::2], *names[high:]]


def errors_across(
    merged: Map, renamed: dict[str, str], first: list[str], true: dict[str, pycolmap.Rigid3d]
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the poses of the second half's photos relative to those of the first: distance and angle."""
    distances, angles = [], []
    for name in renamed.keys() - set(first):
        pose = merged.images[renamed[name]].cam_from_world()
        for other in first:
            found = pose * merged.images[other].cam_from_world().inverse()
            wanted = true[name] * true[other].inverse()
            centers = [one.inverse().translation for one in (found, wanted)]
            distances.append(float(np.linalg.norm(centers[0] - centers[1])))
            angles.append(rotation_error_deg(found, wanted))
    return np.array(distances), np.array(angles)


def row(case: Case, source: Path, output: Path) -> str:
    """The line of a case."""
    poses = source / "transforms.json"
    true = read_transforms(poses)[1]
    parts = halves(sorted(true), shares_photos=case.shares_photos)
    kind = "shared" if case.shares_photos else "apart"
    first, _ = built(source, parts[0], output / f"{kind}-first", poses)
    name = f"{kind}-second{'-plain' if case.is_plain else ''}"
    second, _ = built(source, parts[1], output / name, None if case.is_plain else poses)
    try:
        found = merge(first, second, progress=shown)
    except SlimsfmError as error:
        return f"| {case.title} | {len(first.images)}, {len(second.images)} | refused: {error} | | |"
    distances, angles = errors_across(found.map, dict(found.names), list(first.images), true)
    return (
        f"| {case.title} | {len(first.images)}, {len(second.images)} | {100 * np.median(distances):.2f} cm, "
        f"{100 * np.quantile(distances, 0.9):.2f} cm | {np.median(angles):.2f} deg | {found.joined_points} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    arguments = parser.parse_args()
    rows = [row(case, arguments.folder, arguments.output) for case in CASES]
    print("\n| halves | images | distance: median, 90 % | angle, median | points joined |")
    print("|---|---|---|---|---|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
