"""Which photo each given pose is of: by the name of its file, by the time, or by order."""

import os
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from slimsfm.errors import InputError
from slimsfm.mapping.known_poses.given import GivenPoses
from slimsfm.mapping.pairs import in_order

_TICKS = 1.0, 1e-3, 1e-6, 1e-9  # seconds: the units of times in names of files
_ANY_S = 0.02  # seconds within which a time fits where there is only one


@dataclass(frozen=True, kw_only=True, eq=False)
class PhotosToPose:
    """Photos that poses are searched for."""

    folder: Path
    """Their folder."""

    names: Sequence[str]
    """Their names, relative to the folder."""

    seconds: Mapping[str, float]
    """When frames of videos are shown, by name."""


def match_photos(given: GivenPoses, photos: PhotosToPose) -> dict[str, str]:
    """The key of the pose of each photo that has one, by name of photo.

    A name of a pose is that of a photo if both lead to the same path, or else if no other photo shares as
    many parts of its path, from the last; its suffix may be missing. A time, in seconds, is that of the photo
    nearest to it, within half the distance of frames or poses; names may be times in seconds, milliseconds,
    microseconds or nanoseconds. Where no name is a time, times from 0, 1, ... are the order of the names, as
    `localize` writes them. Numbers are those in the names, if all names are numbers, or else their order.

    Raises:
        InputError: Two poses are of one photo, or nothing tells which poses and photos belong together.
    """
    return _WAYS[given.key](given, photos)


def _by_name(given: GivenPoses, photos: PhotosToPose) -> dict[str, str]:
    roots = Path(os.path.realpath(given.folder)), Path(os.path.realpath(photos.folder))
    paths = {os.path.normpath(roots[1] / name): name for name in photos.names}
    by_stem = defaultdict(list)
    for name in photos.names:
        by_stem[PurePosixPath(name).stem].append(name)
    found: dict[str, str] = {}
    for key in given.cam_from_world:
        name = key if key in paths.values() else paths.get(os.path.normpath(roots[0] / key))
        name = name or _most_alike(key, by_stem)
        if name is None:
            continue
        if name in found:
            raise InputError(
                f"{given.source}: {found[name]} and {key} may both be the photo {name}; give the folder that "
                "their names are relative to"
            )
        found[name] = key
    return found


def _most_alike(key: str, by_stem: Mapping[str, list[str]]) -> str | None:
    """The photo whose path ends most like a key, if there is only one."""
    path = PurePosixPath(key)
    candidates = by_stem.get(path.stem, []) + (by_stem.get(path.name, []) if path.suffix else [])
    whole = [name for name in candidates if PurePosixPath(name).name == path.name]
    candidates = whole or [
        name for name in candidates if not path.suffix or path.name == PurePosixPath(name).stem
    ]
    scores = {name: _equal_parts(path.parts[:-1], PurePosixPath(name).parts[:-1]) for name in candidates}
    best = [name for name, score in scores.items() if score == max(scores.values())]
    return best[0] if len(best) == 1 else None


def _equal_parts(a: Sequence[str], b: Sequence[str]) -> int:
    """How many parts are equal, from the last."""
    equal = [one == other for one, other in zip(reversed(a), reversed(b), strict=False)]
    return equal.index(False) if False in equal else len(equal)


def _by_time(given: GivenPoses, photos: PhotosToPose) -> dict[str, str]:
    keys = sorted(given.cam_from_world, key=float)
    times = np.array([float(key) for key in keys])
    seconds = _seconds(photos, times)
    if seconds is None:
        return _by_index(given, photos, dict(zip(times.tolist(), keys, strict=True)))
    names = sorted(photos.names, key=lambda name: (seconds[name], name))
    at = np.array([seconds[name] for name in names])
    nearest = np.abs(times[None] - at[:, None]).argmin(axis=1)
    off = np.abs(times[nearest] - at)
    best: dict[int, int] = {}  # photo by pose: the nearest one
    for row in np.flatnonzero(off <= _half_a_frame(at, times)).tolist():
        pose = int(nearest[row])
        if pose not in best or off[row] < off[best[pose]]:
            best[pose] = row
    return {names[row]: keys[pose] for pose, row in best.items()}


def _seconds(photos: PhotosToPose, times: np.ndarray) -> dict[str, float] | None:
    """When each photo was taken, by name; None if that is not known of all."""
    if all(name in photos.seconds for name in photos.names):
        return {name: photos.seconds[name] for name in photos.names}
    numbers = {name: _number(PurePosixPath(name).stem) for name in photos.names}
    known = {name: number for name, number in numbers.items() if number is not None}
    return _in_seconds(known, times) if len(known) == len(numbers) else None


def _by_index(given: GivenPoses, photos: PhotosToPose, keys: Mapping[float, str]) -> dict[str, str]:
    """Times that are the order of the photos."""
    names = in_order(photos.names)
    if all(time.is_integer() and 0 <= time < len(names) for time in keys):
        return {names[int(time)]: key for time, key in keys.items()}
    timeless = next(name for name in names if _number(PurePosixPath(name).stem) is None)
    raise InputError(
        f"{given.source}: its poses have times, but the name of the photo {timeless} is none; name the "
        "photos by their times"
    )


def _half_a_frame(at: np.ndarray, times: np.ndarray) -> float:
    """Half the distance of photos or of poses in time, whichever is less."""
    steps = [float(np.median(np.diff(one))) / 2 for one in (at, times) if len(one) > 1]
    return min(steps, default=_ANY_S)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _in_seconds(numbers: Mapping[str, float], times: np.ndarray) -> dict[str, float]:
    """Times of names in the unit in which most lie between the first and the last pose."""
    values = np.array(list(numbers.values()))
    margin = 1.0 + np.ptp(times) / 10
    counts = [
        int(np.sum((values * tick >= times.min() - margin) & (values * tick <= times.max() + margin)))
        for tick in _TICKS
    ]
    tick = _TICKS[int(np.argmax(counts))]
    return {name: number * tick for name, number in numbers.items()}


def _by_order(given: GivenPoses, photos: PhotosToPose) -> dict[str, str]:
    names, count = in_order(photos.names), len(given.cam_from_world)
    stems = [PurePosixPath(name).stem for name in names]
    numbers = [int(stem) for stem in stems if stem.isdecimal()]
    if len(set(numbers)) == len(names) and max(numbers) < count:
        return {name: str(number) for name, number in zip(names, numbers, strict=True)}
    if len(names) != count:
        raise InputError(
            f"{given.source}: has {count} poses, but there are {len(names)} photos, whose names are not the "
            "numbers of poses from 0"
        )
    return {name: str(row) for row, name in enumerate(names)}


_WAYS: dict[str, Callable[[GivenPoses, PhotosToPose], dict[str, str]]] = {
    "name": _by_name,
    "time": _by_time,
    "order": _by_order,
}
