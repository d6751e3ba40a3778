"""Write poses as JSON, CSV, TUM trajectories or COLMAP's images.txt; the name of the file decides."""

import csv
import json
from collections.abc import Callable, Iterable, Mapping
from itertools import count, pairwise
from pathlib import Path
from typing import NamedTuple, TextIO

import pycolmap

from slimsfm.errors import OutputError
from slimsfm.files import replacing
from slimsfm.localization.outcome import Localization
from slimsfm.mapping.info import MapInfo
from slimsfm.pose import PoseEstimate

Results = Mapping[str, Localization]
"""Outcome of each query, by image name."""

ObjectResults = Mapping[str, Results]
"""The same by name of the object, if images were searched for several."""


class _Row(NamedTuple):
    label: dict[str, str | float | None]
    """Object (if there are several), name and (if it is a frame) time of a query."""

    outcome: Localization
    """Its outcome."""

    info: MapInfo | None
    """What the map says of its unit and place, if the caller knows it."""


def write_poses(
    path: str | Path,
    results: Results,
    *,
    info: MapInfo | None = None,
    seconds: Mapping[str, float | None] | None = None,
    overwrite: bool = False,
) -> None:
    """Write poses in the format that the name of the file asks for.

    - `.json` and `.csv` hold every query, localized or not, why not, and how long it took. With `info`,
      `.json` says the unit, and if the map knows its place, the `geopose` of each localized query (see
      `GeoPose`).
    - `images.txt` holds the localized queries in COLMAP's format, which has no names with spaces.
    - Any other `.txt`, and `.tum`, holds the localized queries as a TUM trajectory: one line
      `index tx ty tz qx qy qz qw` per pose of a camera in the world; the index counts all queries. Where all
      queries have a time, and the times increase, the time replaces the index.

    Args:
        path: The file to write.
        results: Outcome of each query.
        info: What the map says of itself, `Map.info`.
        seconds: Time of each query in its video, by name, for the frames of a video. It is `seconds` in
            `.json` and `.csv`; `images.txt` has no times.
        overwrite: Whether to replace an existing file.

    Raises:
        OutputError: The suffix is unknown, the format cannot hold a name, or the file exists or cannot be
            written.
    """
    check_names_for(path, results)
    times = {name: {"seconds": seconds[name]} if seconds else {} for name in results}
    rows = [_Row({"name": name, **times[name]}, one, info) for name, one in results.items()]
    _write(Path(path), rows, overwrite=overwrite)


def write_object_poses(
    path: str | Path,
    results: ObjectResults,
    *,
    infos: Mapping[str, MapInfo] | None = None,
    overwrite: bool = False,
) -> None:
    """Write the poses of several objects, image by image, as .json or .csv.

    Args:
        path: The file to write.
        results: Outcome of each query, by object.
        infos: What the map of each object says of itself, as in `write_poses`.
        overwrite: Whether to replace an existing file.

    Raises:
        OutputError: The suffix is another one, or the file exists or cannot be written.
    """
    path = Path(path)
    writer_for(path, several=True)
    names = dict.fromkeys(name for of_object in results.values() for name in of_object)
    rows = [
        _Row({"object": key, "name": name}, of_object[name], (infos or {}).get(key))
        for name in names
        for key, of_object in results.items()
    ]
    _write(path, rows, overwrite=overwrite)


def _write(path: Path, rows: list[_Row], *, overwrite: bool) -> None:
    write = writer_for(path)
    with (
        replacing(path, overwrite=overwrite) as partial,
        partial.open("w", newline="", encoding="utf-8") as file,
    ):
        write(file, rows)


def writer_for(path: str | Path, *, several: bool = False) -> Callable[[TextIO, list[_Row]], None]:
    """The function that writes the format that a path asks for.

    Raises:
        OutputError: The suffix is unknown, or its format cannot hold several objects.
    """
    path = Path(path)
    if several and path.suffix not in _WITH_OBJECTS:
        raise OutputError(f"{path}: poses of several objects are written as .json or .csv")
    if path.name == "images.txt":
        return _write_colmap
    if path.suffix not in _WRITERS:
        raise OutputError(
            f"{path}: poses are written as .json, .csv, .txt or .tum (TUM), or images.txt (COLMAP)"
        )
    return _WRITERS[path.suffix]


def check_names_for(path: str | Path, names: Iterable[str]) -> None:
    """Check that the format that a path asks for can hold the names of the queries.

    Raises:
        OutputError: It cannot: COLMAP reads a name in images.txt up to its first space.
    """
    for name in names if Path(path).name == "images.txt" else ():
        if name.split() != [name]:
            raise OutputError(
                f"{path}: COLMAP's images.txt cannot hold a name with spaces, such as {name!r}; rename it "
                "or write .json or .csv"
            )


def _write_json(file: TextIO, rows: list[_Row]) -> None:
    images = [
        {
            **label,
            "localized": one.pose is not None,
            "reason": one.reason,
            "cam_from_world": one.pose and _pose_to_json(one.pose.cam_from_world),
            **_geopose(one, info),
            "confidence": one.pose and one.pose.confidence,
            "predicted_corner_error": one.predicted_corner_error,
            "covariance": one.pose and _covariance_to_json(one.pose),
            "orientation": one.orientation,
            "focal_length_px": None if one.is_skipped else one.camera.mean_focal_length(),
            "camera_source": one.camera_source,
            "camera_estimated": list(one.camera_estimated),
            "position_bound_95": one.pose and one.pose.position_bound,
            "rotation_bound_95_deg": one.pose and one.pose.rotation_bound_deg,
            "inliers": one.pose.num_inliers if one.pose else 0,
            "matches": one.num_matches,
            "references_tried": one.references,
            **_milliseconds(one),
        }
        for label, one, info in rows
    ]
    convention = (
        "cam_from_world: x_in_cam = R @ x_in_world + t; quaternions are x, y, z, w; "
        "reason: why an image is not localized; "
        "confidence: probability of a corner error below a tenth of the box's diagonal; "
        "predicted_corner_error: over the diagonal; "
        "position_bound_95 (map units), rotation_bound_95_deg: hold with 95 % probability; "
        "camera_source: given, map, queries, exif or unknown; camera_estimated: by the matches; "
        "covariance: of a turn (radians) and then a shift (map units) in the camera's frame; "
        "orientation: whether the camera is that of the upright image or of its stored pixels"
    )
    if any("seconds" in row.label for row in rows):
        convention += "; seconds: when the frame of a video is shown"
    if any(row.info and row.info.georeference for row in rows):
        convention += f"; {_GEOPOSE}"
    units = {row.info.unit for row in rows if row.info}
    unit = {"unit": units.pop()} if len(units) == 1 else {}
    json.dump({"convention": convention, **unit, "images": images}, file, indent=2)
    file.write("\n")


def _geopose(one: Localization, info: MapInfo | None) -> dict:
    if info is None or info.georeference is None:
        return {}
    return {"geopose": one.pose and info.georeference.geopose(one.pose.cam_from_world).to_json()}


def _covariance_to_json(pose: PoseEstimate) -> list[list[float]] | None:
    return None if pose.covariance is None else pose.covariance.tolist()


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


def _write_csv(file: TextIO, rows: list[_Row]) -> None:
    times = ["ms_extract", "ms_match", "ms_pose", "ms_total"]
    pose = ["qw", "qx", "qy", "qz", "tx", "ty", "tz", "confidence", "inliers", "matches"]
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([*(rows[0].label if rows else ["name"]), *pose, *times, "orientation", "reason"])
    for label, one, _ in rows:
        values = [*_colmap_values(one.pose.cam_from_world), one.pose.confidence] if one.pose else [""] * 8
        inliers = one.pose.num_inliers if one.pose else 0
        counts, times_ms = (inliers, one.num_matches), _milliseconds(one).values()
        writer.writerow([*label.values(), *values, *counts, *times_ms, one.orientation, one.reason or ""])


def _colmap_values(cam_from_world: pycolmap.Rigid3d) -> list[float]:
    """Rotation as w, x, y, z, then translation."""
    x, y, z, w = cam_from_world.rotation.quat.tolist()
    return [w, x, y, z, *cam_from_world.translation.tolist()]


def _pixels(rows: list[_Row]) -> str:
    """Whose poses these are, for a comment; all queries of one map are read alike."""
    is_stored = any(one.orientation == "stored" for _, one, _ in rows)
    return "images as they are stored, ignoring EXIF orientation" if is_stored else "upright images"


def _write_tum(file: TextIO, rows: list[_Row]) -> None:
    seconds = [row.label.get("seconds") for row in rows]
    known = [one for one in seconds if isinstance(one, float)]
    timed = len(known) == len(rows) and all(before < after for before, after in pairwise(known))
    first = "seconds" if timed else "index"
    file.write(f"# {first} tx ty tz qx qy qz qw of the cameras of {_pixels(rows)}\n")
    for index, (_, one, _) in zip(known if timed else count(), rows, strict=False):
        if one.pose:
            world_from_cam = one.pose.cam_from_world.inverse()
            values = [*world_from_cam.translation, *world_from_cam.rotation.quat]
            file.write(f"{index} " + " ".join(repr(float(value)) for value in values) + "\n")


def _write_colmap(file: TextIO, rows: list[_Row]) -> None:
    file.write("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty line: no keypoints\n")
    file.write(f"# of the cameras of {_pixels(rows)}\n")
    for index, (label, one, _) in enumerate(rows, start=1):
        if one.pose:
            values = " ".join(repr(value) for value in _colmap_values(one.pose.cam_from_world))
            file.write(f"{index} {values} 1 {label['name']}\n\n")


_GEOPOSE = (
    "geopose: OGC GeoPose 1.0, Basic-Quaternion; its quaternion turns vectors of the camera frame (x right, "
    "y down, z forward) into east, north, up at its position"
)

_WITH_OBJECTS = (".json", ".csv")

_WRITERS: dict[str, Callable[[TextIO, list[_Row]], None]] = {
    ".json": _write_json,
    ".csv": _write_csv,
    ".txt": _write_tum,
    ".tum": _write_tum,
}
