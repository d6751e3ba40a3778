"""What can be damaged: the files of maps, of a run, of other programs, and queries; and what reads them."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slimsfm.evaluation.comparison import compare_runs
from slimsfm.evaluation.result_files import read_run
from slimsfm.features import Features
from slimsfm.geometry import corner_error
from slimsfm.graph.io import read_given_graph
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.cameras import query_camera, read_gravity
from slimsfm.mapping import ImportOptions, Map, import_colmap, read_map
from slimsfm.mapping.camera_file import read_camera
from slimsfm.mapping.model import read_box
from slimsfm.photos import read_photo
from slimsfm.pose import PoseEstimate
from slimsfm.report import write_report

SURE, RIGHT = 0.9, 0.1  # confidence, and corner error over the diagonal

Read = Callable[[Path], bytes]
"""Uses what is in a folder, and returns what came out."""


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Undamaged files, all of one object."""

    full: Path
    """A map with features and matches."""

    slim: Path
    """A map for direct matching."""

    run: Path
    """A run with its maps."""

    photos: Path
    """Folder of queries as JPEG and PNG."""

    others: Path
    """Files of other programs: features.h5, matches.h5, sfm/ and text/, graph.npz, camera.txt, box.json,
    gravity.json."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A folder whose files are damaged one at a time."""

    kind: str
    """What it is."""

    folder: Path
    """The undamaged folder."""

    files: tuple[str, ...]
    """The files to damage, by path in the folder."""

    read: Read
    """Uses the folder."""

    may_differ: bool = False
    """Whether another result is no failure, because nothing in the folder can reveal it."""


def subjects(sources: Sources, work: Path) -> Iterator[Subject]:
    """Everything that is damaged; older maps, which have no checksums, are made in `work`."""
    features = _some_features(read_map(sources.full))
    for kind, folder in (("map", sources.full), ("slim map", sources.slim)):
        read = _localizing(features)
        older = _without_checksums(folder, work / f"older {kind}")
        yield Subject(kind=kind, folder=folder, files=_files(folder), read=read)
        yield Subject(kind=f"older {kind}", folder=older, files=_files(older), read=read, may_differ=True)
    results = tuple(name for name in _files(sources.run) if name.endswith(".json") and "maps/" not in name)
    yield Subject(kind="run", folder=sources.run, files=results, read=_reporting, may_differ=True)
    localizer = Localizer(read_map(sources.slim), LocalizationOptions(min_confidence=0.0))
    for name in _files(sources.photos):
        yield Subject(
            kind="query", folder=sources.photos, files=(name,), read=_judging(localizer, sources.photos, name)
        )
    yield from _of_other_programs(sources)


def _of_other_programs(sources: Sources) -> Iterator[Subject]:
    folder, full = sources.others, read_map(sources.full)
    readers: dict[str, Read] = {
        "features.h5": _importing("sfm"),
        "matches.h5": _importing("sfm"),
        **{name: _importing("sfm") for name in _files(folder) if name.startswith("sfm/")},
        **{name: _importing("text") for name in _files(folder) if name.startswith("text/")},
        "graph.npz": lambda here: read_given_graph(here / "graph.npz", full).errors.data.tobytes(),
        "camera.txt": lambda here: repr(read_camera(here / "camera.txt")).encode(),
        "box.json": lambda here: read_box(here / "box.json").corners.tobytes(),
        "gravity.json": lambda here: repr(read_gravity(here / "gravity.json")).encode(),
    }
    for name, read in readers.items():
        yield Subject(kind="other files", folder=folder, files=(name,), read=read, may_differ=True)


def _files(folder: Path) -> tuple[str, ...]:
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    return tuple(path.relative_to(folder).as_posix() for path in found)


def _without_checksums(map_path: Path, copy: Path) -> Path:
    shutil.copytree(map_path, copy, dirs_exist_ok=True)
    data = json.loads((copy / "map.json").read_text())
    del data["checksums"]
    (copy / "map.json").write_text(json.dumps(data))
    return copy


def _some_features(full: Map) -> dict[str, Features]:
    names = list(full.images)
    return {name: full.features[name] for name in (names[0], names[len(names) // 2])}


def _localizing(queries: dict[str, Features]) -> Read:
    """Localize features of known images, and read all that a map holds."""

    def read(folder: Path) -> bytes:
        found = read_map(folder)
        held = [one.descriptors.tobytes() for one in found.features.values()]
        held += [pairs.tobytes() for pairs in found.matches.values()]
        localizer, poses = Localizer(found), []
        for features in queries.values():
            pose = localizer.localize_features(features, next(iter(found.cameras)).camera).pose
            poses.append(b"" if pose is None else pose.cam_from_world.matrix().tobytes())
        return b"".join([*poses, str(len(held)).encode()])

    return read


def _reporting(folder: Path) -> bytes:
    """Write the page of a run, and compare the run with itself."""
    run = read_run(folder)
    compare_runs(run, run)
    page = folder / "report.html"
    write_report(page, run, overwrite=True)
    data = page.read_bytes()
    page.unlink()
    return data


def _judging(localizer: Localizer, undamaged: Path, name: str) -> Read:
    """Localize a photo: a sure pose must be that of the undamaged photo."""

    def localized(folder: Path) -> PoseEstimate | None:
        photo = read_photo(folder / name, localizer.map.info.orientation)
        return localizer.localize(photo.image, query_camera(localizer.map, folder / name, None)).pose

    right = localized(undamaged)

    def read(folder: Path) -> bytes:
        pose = localized(folder)
        if right is None or pose is None or (pose.confidence or 0) < SURE:
            return b"right or unsure"
        error = corner_error(pose.cam_from_world, right.cam_from_world, localizer.map.box)
        return b"right or unsure" if error < RIGHT else b"wrong and sure"

    return read


def _importing(model: str) -> Read:
    """Import a model with hloc's features and matches."""

    def read(folder: Path) -> bytes:
        options = ImportOptions(features=folder / "features.h5", matches=folder / "matches.h5")
        made = import_colmap(folder / model, options=options)
        return made.fingerprint.encode() + np.float64(len(made.matches)).tobytes()

    return read
