"""Add photos to a map, without moving what it has and without forcing in what is not sure."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from slimsfm.errors import InputError, MapError
from slimsfm.execution import OpenExecutor
from slimsfm.mapping.blocks import Workers
from slimsfm.mapping.map import Map
from slimsfm.mapping.sfm import colmap_warnings
from slimsfm.mapping.workspace import opened_workspace
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.added_info import described
from slimsfm.upkeep.coverage import Coverage, coverage
from slimsfm.upkeep.new_photos import NewPhotos, read_new_photos
from slimsfm.upkeep.refinement import Movement, refined
from slimsfm.upkeep.rounds import Adding, AddOptions

_NUMBER = re.compile(r"\d+(\.\d+)?")  # reasons that differ in numbers alone are one


@dataclass(frozen=True, kw_only=True, eq=False)
class Addition:
    """A map with the photos that were added to it."""

    map: Map
    """The larger map; the map itself if nothing was added."""

    added: tuple[str, ...]
    """Names of the photos that were added, sorted."""

    known: tuple[str, ...]
    """Names of the photos that were in the map already."""

    left_out: Mapping[str, str]
    """Why each other photo was not added, by name."""

    notes: tuple[str, ...]
    """Sentences, with names, on what was skipped or ignored."""

    before: Coverage
    """What the map had seen before."""

    after: Coverage
    """What the larger map has seen, in the same cells."""

    rounds: int
    """How often the photos that were left were tried."""

    movement: Movement | None = None
    """How far the old images moved; None if nothing was refined, so that they did not."""


def add(
    map: Map,
    images: str | Path,
    options: AddOptions = AddOptions(),
    *,
    workspace: str | Path | None = None,
    open_executor: OpenExecutor | None = None,
    progress: ProgressBar = silent,
    min_seconds: float = Workers.min_seconds,
) -> Addition:
    """Add the photos of a folder to a map.

    Each photo is localized in the map. Those that are sure are matched with their likely neighbors,
    triangulated, and adjusted (`extend_map`); then those of the others that look similar to them are tried
    again in the larger map, until none enters any more. Photos that only see each other therefore never
    enter. Ids, poses and cameras of the old images and the frame of the map stay as they are, unless
    `options.refine` is set.

    Args:
        map: A full map of keypoints.
        images: Folder of photos; those that are in the map already do not count. Or one photo.
        options: How to add.
        workspace: Folder that keeps features and matches; an equal call goes on from those that an
            interrupted one left. By default a temporary folder.
        open_executor: Opens the executor that extracts and matches features; None: this process. The map has
            equal bytes in any case.
        progress: Progress callback.
        min_seconds: As in `Workers`.

    Raises:
        InputError: There is no photo, or the map has another one of the same name, or none of the photos
            could be added although none is in the map.
        ImageError: No photo can be read.
        MapError: The map was reduced, or built without a detector.
    """
    check_extendable(map)
    workers = Workers(open_executor=open_executor, min_seconds=min_seconds)
    with opened_workspace(workspace) as folder, colmap_warnings():
        photos = read_new_photos(
            map,
            Path(images),
            folder,
            matcher=options.matcher,
            strict=options.strict,
            workers=workers,
            progress=progress,
        )
        state = Adding(map=map, photos=photos, options=options, workers=workers, progress=progress)
        state.run()
    if photos.names and not state.added and not photos.known:
        raise InputError(f"{images}: {_none_of(photos, state.reasons)}")
    larger, movement = state.map, None
    if state.added:
        if options.refine:
            larger, movement = refined(larger, map)
        larger = described(map, larger, photos, state.added)
    left_out = {name: state.reasons[name] for name in sorted(state.reasons)}
    return Addition(
        map=replace(larger, unregistered=tuple(left_out)) if state.added else map,
        added=tuple(sorted(state.added)),
        known=photos.known,
        left_out=left_out,
        notes=photos.notes,
        before=coverage(map),
        after=coverage(larger, map.box),
        rounds=state.rounds,
        movement=movement,
    )


def check_extendable(map: Map, path: Path | None = None) -> None:
    """Check that photos can be added to a map.

    Args:
        map: The map.
        path: Its folder, by which the map that it was reduced from is named.

    Raises:
        MapError: The map was reduced, or built without a detector.
    """
    where = f"{path}: " if path else ""
    if map.info.parent is not None or map.kind != "full":
        raise MapError(
            f"{where}is a reduced map, and photos are added to full maps only: add them to "
            f"{_parent_of(map, path)}, and repeat the reduction on the larger map"
        )
    if not map.has_keypoints:
        raise MapError(
            f"{where}was built without a detector ({map.info.extractor}), and photos cannot be added to such "
            "a map: build it again from all photos"
        )


def _parent_of(map: Map, path: Path | None) -> str:
    """The map that a map was reduced from, as its user finds it."""
    if map.info.parent is None:
        return "the map that it was made from"
    parent = Path(os.path.normpath((path or Path()) / map.info.parent.path))
    found = "" if (parent / "map.json").is_file() else " (which is not there any more)"
    return f"{parent}{found}, which it was made from"


def _none_of(photos: NewPhotos, reasons: Mapping[str, str]) -> str:
    """One line on why no photo was added, with a name for each reason."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in sorted(reasons.items()):
        by_reason.setdefault(_NUMBER.sub("", reason), []).append(name)
    why = "; ".join(
        f"{reasons[names[0]]} ({names[0]}{f' and {len(names) - 1} more alike' if len(names) > 1 else ''})"
        for names in by_reason.values()
    )
    return f"none of {len(photos.names)} photos could be added; they may show another place: {why}"
