"""Features and matches on disk, in hloc's HDF5 layout.

`features.h5`: one group per image name with `keypoints` (n, 2), `descriptors` (d, n), `scores` (n) and
`image_size` (2), and if the detector estimates them `scales` (n) and `oris` (n). `oris` are in radians;
hloc's own are in degrees and recognized by values larger than a full turn.
`matches.h5`: one group `A/B` per pair of image names ("/" in a name becomes "-") with `matches0` (for each
keypoint of A its match in B or -1) and `matching_scores0`.

hloc puts the center of the top-left pixel at (0, 0), everything else in slimsfm at (0.5, 0.5). Only this
module converts.
"""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from jaxtyping import Float32, Integer

from slimsfm.arrays import IndexPairs
from slimsfm.errors import InputError
from slimsfm.features.base import Features
from slimsfm.files import uninterrupted

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_PIXEL_CENTER = np.float32(0.5)
_INT16_MAX = np.iinfo(np.int16).max
_TURN = 2 * np.pi + 0.01  # half floats round


class FeatureFile(Mapping[str, Features]):
    """The features in a file by image name, sorted, read on access.

    Raises:
        InputError: The file is missing or damaged, at construction; an entry is damaged, at access.
    """

    def __init__(self, path: Path) -> None:
        self._file = opened(path)
        self._path = path
        self._names = dict.fromkeys(sorted(_groups_with(self._file, "keypoints")))

    def __getitem__(self, name: str) -> Features:
        if name not in self._names:
            raise KeyError(name)
        try:
            return _read_features(self._file, name)
        except (LookupError, OSError, TypeError, ValueError) as error:
            raise InputError(f"{self._path}: the features of {name!r} are damaged ({error})") from error

    def count(self, name: str) -> int:
        """Number of features of an image, without reading them."""
        keypoints = self._file[f"{name}/keypoints"]
        return keypoints.shape[0] if isinstance(keypoints, h5py.Dataset) and keypoints.shape else 0

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def read_array(file: h5py.File, name: str) -> np.ndarray:
    """Read a dataset, five times faster than `file[name][()]`; KeyError if there is none."""
    try:
        found = h5py.h5d.open(file.id, name.encode())
    except TypeError as error:
        raise KeyError(f"{name} is not a dataset") from error
    values = np.empty(found.shape, found.dtype)
    found.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def _read_features(file: h5py.File, name: str) -> Features:
    keypoints = read_array(file, f"{name}/keypoints").astype(np.float32)
    descriptors = read_array(file, f"{name}/descriptors").T
    scores = read_array(file, f"{name}/scores") if f"{name}/scores" in file else np.ones(len(keypoints))
    if keypoints.ndim != 2 or keypoints.shape[1] < 2 or descriptors.ndim != 2:
        raise ValueError(f"{keypoints.shape} keypoints with {descriptors.T.shape} descriptors")
    if not len(keypoints) == len(descriptors) == len(scores):
        raise ValueError(f"{len(keypoints)} keypoints, {len(descriptors)} descriptors, {len(scores)} scores")
    size = read_array(file, f"{name}/image_size") if f"{name}/image_size" in file else np.zeros(2)
    return Features(
        keypoints=np.ascontiguousarray(keypoints[:, :2]) + _PIXEL_CENTER,
        descriptors=np.ascontiguousarray(descriptors),
        scores=scores.astype(np.float32),
        image_size=(int(size[0]), int(size[1])),
        frames=_read_frames(file, name, len(keypoints)),
    )


def _read_frames(file: h5py.File, name: str, count: int) -> Float32[np.ndarray, "n 2"] | None:
    if f"{name}/scales" not in file or f"{name}/oris" not in file:
        return None
    frames = np.stack([read_array(file, f"{name}/{part}") for part in ("scales", "oris")], axis=1)
    if frames.shape != (count, 2):
        raise ValueError(f"{count} keypoints with scales and oris of shape {frames.shape}")
    frames = frames.astype(np.float32)
    if np.any(np.abs(frames[:, 1]) > _TURN):
        frames[:, 1] = np.radians(frames[:, 1])
    return frames


class MatchFile(Mapping[tuple[str, str], IndexPairs]):
    """The verified matches in a file by pair of image names, read on access.

    Each pair has one entry, in the order of names in the file.

    Raises:
        InputError: The file is missing or damaged, at construction; an entry is damaged, at access.
    """

    def __init__(self, path: Path, names: list[str]) -> None:
        self._file = opened(path)
        self._path = path
        by_key = {_key(name): name for name in names}
        groups = (group.split("/") for group in _groups_with(self._file, "matches0"))
        pairs = ((by_key.get(group[0]), by_key.get(group[-1])) for group in groups)
        self._pairs = dict.fromkeys(sorted((a, b) for a, b in pairs if a is not None and b is not None))

    def __getitem__(self, pair: tuple[str, str]) -> IndexPairs:
        if pair not in self._pairs:
            raise KeyError(pair)
        try:
            targets = read_array(self._file, f"{_key(pair[0])}/{_key(pair[1])}/matches0").astype(np.int64)
        except (KeyError, OSError, TypeError, ValueError) as error:
            raise InputError(f"{self._path}: the matches of {pair} are damaged ({error})") from error
        rows = np.flatnonzero(targets >= 0)
        return np.stack([rows, targets[rows]], axis=1)

    def __contains__(self, pair: object) -> bool:
        return pair in self._pairs

    def __iter__(self) -> Iterator[tuple[str, str]]:
        return iter(self._pairs)

    def __len__(self) -> int:
        return len(self._pairs)


class FeatureWriter:
    """Writes features image by image, so that not all of them need to fit into memory."""

    def __init__(self, path: Path) -> None:
        self._closing = ExitStack()
        self._file = self._closing.enter_context(creating(path))

    def __enter__(self) -> "FeatureWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    def write(self, name: str, features: Features) -> None:
        """Add the features of one image."""
        with uninterrupted():
            _write_features(self._file, name, features)


# Separate functions, because closing their group at the end may write.


def _write_features(file: h5py.File, name: str, features: Features) -> None:
    group = file.create_group(name)
    group["keypoints"] = features.keypoints - _PIXEL_CENTER
    group["descriptors"] = np.ascontiguousarray(features.descriptors.T)
    group["scores"] = features.scores
    group["image_size"] = np.array(features.image_size, np.int64)
    if features.frames is not None:
        group["scales"], group["oris"] = features.frames.T


def _write_targets(file: h5py.File, name: str, targets: Integer[np.ndarray, " n"]) -> None:
    group = file.create_group(name)
    group.create_dataset("matches0", data=targets, compression="gzip", shuffle=True)
    scores = (targets >= 0).astype(np.float16)
    group.create_dataset("matching_scores0", data=scores, compression="gzip", shuffle=True)


def write_matches(
    path: Path, matches: Mapping[tuple[str, str], IndexPairs], num_keypoints: Mapping[str, int]
) -> None:
    """Write verified matches, in sorted order of the pairs."""
    with creating(path) as file:
        for a, b in sorted(matches):
            pairs = matches[a, b]
            kind = np.int16 if num_keypoints[b] <= _INT16_MAX else np.int32
            targets = np.full(num_keypoints[a], -1, kind)
            targets[pairs[:, 0]] = pairs[:, 1]
            with uninterrupted():
                _write_targets(file, f"{_key(a)}/{_key(b)}", targets)


@contextmanager
def creating(path: Path) -> Iterator[h5py.File]:
    """Create an HDF5 file, or replace it; a full disk raises OSError."""
    path.unlink(missing_ok=True)  # open readers keep the old file
    with _PatientFile(path, "w+b") as raw:
        file = None
        try:
            with uninterrupted():
                file = h5py.File(raw, "w", libver="latest")
            yield file
        finally:
            with uninterrupted():
                if file is not None:  # a deferred interruption may arrive before the assignment
                    file.close()
        if raw.failure:
            raise raw.failure


class _PatientFile(FileIO):
    """Records write errors instead of raising them, because HDF5 crashes the process if the disk is full."""

    failure: OSError | None = None

    def write(self, data: "ReadableBuffer", /) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and not self.failure:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.failure = error
        return size


def opened(path: Path) -> h5py.File:
    """Open an HDF5 file for reading.

    Raises:
        InputError: The file is missing or damaged.
    """
    try:
        return h5py.File(path, "r")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except OSError as error:
        raise InputError(f"{path}: not a readable HDF5 file; it may be cut short") from error


def _groups_with(file: h5py.File, dataset: str) -> list[str]:
    found: list[str] = []

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Group) and dataset in item:
            found.append(name)

    file.visititems(visit)
    return found


def _key(name: str) -> str:
    return name.replace("/", "-")
