"""Poses on disk: JSON, CSV, TUM trajectories and COLMAP's images.txt, chosen by the file's name."""

import csv
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TextIO

import pycolmap

from slimsfm.errors import OutputError
from slimsfm.files import replacing
from slimsfm.localization.localizer import Localization

Results = Mapping[str, Localization]
"""What became of each query, by image name."""


def write_poses(path: Path, results: Results, *, overwrite: bool = False) -> None:
    """Write poses in the format that the path's suffix names.

    .json and .csv hold every query, localized or not, with times; .txt holds those localized: as COLMAP's
    images.txt if that is the file's name, else as a TUM trajectory (`index tx ty tz qx qy qz qw`, the pose of
    the camera in the world, index counting the queries). COLMAP reads a name in
    images.txt up to its first space.

    Raises:
        OutputError: The suffix is none of these, or the file cannot be written.
    """
    write = writer_for(path)
    with replacing(path, overwrite=overwrite) as partial, partial.open("w", newline="") as file:
        write(file, results)


def writer_for(path: Path) -> Callable[[TextIO, Results], None]:
    """The format that a path names.

    Raises:
        OutputError: It names none.
    """
    if path.name == "images.txt":
        return _write_colmap
    if path.suffix not in _WRITERS:
        raise OutputError(
            f"{path}: poses are written as .json, .csv, .txt or .tum (TUM), or images.txt (COLMAP)"
        )
    return _WRITERS[path.suffix]


def _write_json(file: TextIO, results: Results) -> None:
    images = [
        {
            "name": name,
            "localized": one.pose is not None,
            "cam_from_world": one.pose and _pose_to_json(one.pose.cam_from_world),
            "inliers": one.pose.num_inliers if one.pose else 0,
            "matches": one.num_matches,
            **_milliseconds(one),
        }
        for name, one in results.items()
    ]
    convention = "cam_from_world: x_in_cam = R @ x_in_world + t; quaternions are x, y, z, w"
    json.dump({"convention": convention, "images": images}, file, indent=2)
    file.write("\n")


def _pose_to_json(cam_from_world: pycolmap.Rigid3d) -> dict:
    return {
        "quaternion_xyzw": cam_from_world.rotation.quat.tolist(),
        "translation": cam_from_world.translation.tolist(),
    }


def _milliseconds(one: Localization) -> dict[str, float]:
    seconds = one.seconds
    return {
        f"ms_{stage}": round(1e3 * getattr(seconds, stage), 3)
        for stage in ("extract", "match", "pose", "total")
    }


def _write_csv(file: TextIO, results: Results) -> None:
    times = ["ms_extract", "ms_match", "ms_pose", "ms_total"]
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["name", "qw", "qx", "qy", "qz", "tx", "ty", "tz", "inliers", "matches", *times])
    for name, one in results.items():
        values = _colmap_values(one.pose.cam_from_world) if one.pose else [""] * 7
        inliers = one.pose.num_inliers if one.pose else 0
        writer.writerow([name, *values, inliers, one.num_matches, *_milliseconds(one).values()])


def _colmap_values(cam_from_world: pycolmap.Rigid3d) -> list[float]:
    """Qw qx qy qz tx ty tz."""
    x, y, z, w = cam_from_world.rotation.quat.tolist()
    return [w, x, y, z, *cam_from_world.translation.tolist()]


def _write_tum(file: TextIO, results: Results) -> None:
    for index, one in enumerate(results.values()):
        if one.pose:
            world_from_cam = one.pose.cam_from_world.inverse()
            values = [*world_from_cam.translation, *world_from_cam.rotation.quat]
            file.write(f"{index} " + " ".join(repr(float(value)) for value in values) + "\n")


def _write_colmap(file: TextIO, results: Results) -> None:
    file.write("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty line: no keypoints\n")
    for index, (name, one) in enumerate(results.items(), start=1):
        if one.pose:
            values = " ".join(repr(value) for value in _colmap_values(one.pose.cam_from_world))
            file.write(f"{index} {values} 1 {name}\n\n")


_WRITERS: dict[str, Callable[[TextIO, Results], None]] = {
    ".json": _write_json,
    ".csv": _write_csv,
    ".txt": _write_tum,
    ".tum": _write_tum,
}
