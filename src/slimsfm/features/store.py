"""Features and matches on disk, in hloc's HDF5 layout.

`features.h5`: one group per image name with `keypoints` (n, 2), `descriptors` (d, n), `scores` (n) and
`image_size` (2), and if the detector estimates them `scales` (n) and `oris` (n). `oris` are in radians;
hloc's own are in degrees and recognized by values larger than a full turn.
`matches.h5`: one group `A/B` per pair of image names ("/" in a name becomes "-") with `matches0` (for each
keypoint of A its match in B or -1) and `matching_scores0`. Old files of hloc call the group `A_B`, which is
read as well. Names that differ in "/" and "-" alone get different ends, which hloc does not know.

HDF5 takes a name for a path: `/a.jpg`, `./a.jpg` and `a.jpg` are the same group.

hloc puts the center of the top-left pixel at (0, 0), everything else in slimsfm at (0.5, 0.5). Only this
module converts.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float32, Integer

from slimsfm.arrays import IndexPairs
from slimsfm.features.base import Features
from slimsfm.files import contents_of, uninterrupted
from slimsfm.files.hdf5 import creating, datasets_of, groups_with, opened, read_array, shape_and_type

_PIXEL_CENTER = np.float32(0.5)
_INT16_MAX = np.iinfo(np.int16).max
_TURN = 2 * np.pi + 0.01  # half floats round
_AGAIN = "build or import the map again, or extract and match the features again"


class FeatureFile(Mapping[str, Features]):
    """The features in a file by image name, sorted, read on access.

    HDF5 forgets how a name was spelled, so that `names` gives the spelling of the images that have one.

    Args:
        path: The file.
        names: Names of images as they are spelled elsewhere.
        finite: Whether an entry is damaged if a value is not finite; off where the caller sorts such out.

    Raises:
        InputError: The file is missing or damaged, at construction; an entry is damaged, or its descriptors
            have another length or type than those of other images, at access.
    """

    def __init__(self, path: Path, names: Iterable[str] = (), *, finite: bool = True) -> None:
        self._file = opened(path)
        self._path, self._finite = path, finite
        spelled = {stored_name(name): name for name in names}
        with contents_of(path, "damaged", _AGAIN):
            self._stored = set(datasets_of(self._file))
        groups = groups_with(self._stored, "keypoints")
        self._names = dict.fromkeys(sorted(spelled.get(name, name) for name in groups))
        self._kind: tuple[int, np.dtype] | None = None  # of the descriptors of the first image that has some

    def __getitem__(self, name: str) -> Features:
        if name not in self._names:
            raise KeyError(name)
        with self._contents_of(name):
            features = _read_features(self._file, stored_name(name), self._stored)
            if self._finite:
                _check_finite(features)
            count, length = features.descriptors.shape
            self._check_kind(count, length, features.descriptors.dtype)
        return features

    def count(self, name: str) -> int:
        """Number of features of an image, without reading them."""
        with self._contents_of(name):
            (length, count), kind = shape_and_type(self._file, f"{name}/descriptors")
            self._check_kind(count, length, kind)
            return shape_and_type(self._file, f"{name}/keypoints")[0][0]

    def _contents_of(self, name: str) -> AbstractContextManager[None]:
        return contents_of(self._path, f"the features of {name!r} are damaged", _AGAIN)

    def _check_kind(self, count: int, length: int, kind: np.dtype) -> None:
        if not count:
            return
        self._kind = self._kind or (length, kind)
        if self._kind != (length, kind):
            raise ValueError(
                f"descriptors of {length} values of type {kind}; other images have {self._kind[0]} of type "
                f"{self._kind[1]}"
            )

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def stored_name(name: str) -> str:
    """The name under which HDF5 stores an image: without a slash at the start, empty parts and dots."""
    return "/".join(part for part in name.split("/") if part not in ("", "."))


def _read_features(file: h5py.File, name: str, stored: set[str]) -> Features:
    keypoints = _read_floats(file, f"{name}/keypoints")
    if f"{name}/descriptors" not in stored:
        raise ValueError("keypoints without descriptors")
    descriptors = read_array(file, f"{name}/descriptors").T
    scores = _read_floats(file, f"{name}/scores") if f"{name}/scores" in stored else np.ones(len(keypoints))
    if keypoints.ndim != 2 or keypoints.shape[1] < 2 or descriptors.ndim != 2:
        raise ValueError(f"{keypoints.shape} keypoints with {descriptors.T.shape} descriptors")
    if not (len(keypoints),) == (len(descriptors),) == scores.shape:
        raise ValueError(f"{len(keypoints)} keypoints, {len(descriptors)} descriptors, {scores.shape} scores")
    size = read_array(file, f"{name}/image_size") if f"{name}/image_size" in stored else np.zeros(2)
    return Features(
        keypoints=np.ascontiguousarray(keypoints[:, :2]) + _PIXEL_CENTER,
        descriptors=np.ascontiguousarray(descriptors),
        scores=np.asarray(scores, np.float32),
        image_size=(int(size[0]), int(size[1])),
        frames=_read_frames(file, name, len(keypoints))
        if {f"{name}/scales", f"{name}/oris"} <= stored
        else None,
    )


def _read_floats(file: h5py.File, name: str) -> Float32[np.ndarray, "..."]:
    with np.errstate(over="ignore"):
        return read_array(file, name).astype(np.float32)


def _check_finite(features: Features) -> None:
    for part in ("keypoints", "descriptors", "scores", "frames"):
        values = getattr(features, part)
        if values is not None and values.dtype.kind == "f" and not np.isfinite(values).all():
            raise ValueError(f"some of its {part} are not finite")


def _read_frames(file: h5py.File, name: str, count: int) -> Float32[np.ndarray, "n 2"]:
    frames = np.stack([_read_floats(file, f"{name}/{part}") for part in ("scales", "oris")], axis=1)
    if frames.shape != (count, 2):
        raise ValueError(f"{count} keypoints with scales and oris of shape {frames.shape}")
    if np.any(np.abs(frames[:, 1]) > _TURN):
        frames[:, 1] = np.radians(frames[:, 1])
    return frames


class MatchFile(Mapping[tuple[str, str], IndexPairs]):
    """The verified matches in a file by pair of image names, read on access.

    Each pair has one entry, named in the order of the file. `num_other_pairs` counts pairs of other images.

    Args:
        path: The file.
        names: The images whose matches are read.
        num_keypoints: Their numbers of keypoints; None if the caller checks that no match is beyond them.

    Raises:
        InputError: The file is missing or damaged, at construction; an entry is damaged or matches keypoints
            that its images do not have, at access.
    """

    def __init__(
        self, path: Path, names: Iterable[str], num_keypoints: Mapping[str, int] | None = None
    ) -> None:
        self._file = opened(path)
        self._path, self._num_keypoints = path, num_keypoints
        by_key = {key: name for name, key in _keys(names).items()}
        with contents_of(path, "damaged", _AGAIN):
            groups = groups_with(datasets_of(self._file), "matches0")
        pairs = ((_pair_of(group, by_key), group) for group in groups)
        found = {pair: group for pair, group in pairs if pair is not None}
        self._groups = {pair: found[pair] for pair in sorted(found)}
        self.num_other_pairs = len(groups) - len(found)

    def __getitem__(self, pair: tuple[str, str]) -> IndexPairs:
        if pair not in self._groups:
            raise KeyError(pair)
        with contents_of(self._path, f"the matches of {pair} are damaged", _AGAIN):
            targets = read_array(self._file, f"{self._groups[pair]}/matches0")
            if targets.ndim != 1 or targets.dtype.kind != "i":
                raise ValueError(f"matches0 of shape {targets.shape} and type {targets.dtype}")
            if self._num_keypoints:
                a, b = (self._num_keypoints[name] for name in pair)
                if len(targets) > a or targets.max(initial=-1) >= b:
                    raise ValueError(f"matches beyond the {a} and {b} keypoints of its images")
        rows = np.flatnonzero(targets >= 0)
        return np.stack([rows, targets[rows]], axis=1, dtype=np.int64)

    def __contains__(self, pair: object) -> bool:
        return pair in self._groups

    def __iter__(self) -> Iterator[tuple[str, str]]:
        return iter(self._groups)

    def __len__(self) -> int:
        return len(self._groups)


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
    keys = _keys(num_keypoints)
    with creating(path) as file:
        for a, b in sorted(matches):
            pairs = matches[a, b]
            kind = np.int16 if num_keypoints[b] <= _INT16_MAX else np.int32
            targets = np.full(num_keypoints[a], -1, kind)
            targets[pairs[:, 0]] = pairs[:, 1]
            with uninterrupted():
                _write_targets(file, f"{keys[a]}/{keys[b]}", targets)


def _keys(names: Iterable[str]) -> dict[str, str]:
    """The keys of images in a file of matches, unique within the sorted names."""
    keys, taken = {}, set()
    for name in sorted(names):
        key = name.replace("/", "-")
        while key in taken:
            key += "#"
        keys[name] = key
        taken.add(key)
    return keys


def indistinct_names(names: Iterable[str]) -> list[str]:
    """Names of images that hloc's matches do not tell apart from another one of these names, sorted."""
    names = sorted(names)
    counts = Counter(name.replace("/", "-") for name in names)
    return [name for name in names if counts[name.replace("/", "-")] > 1]


def _pair_of(group: str, by_key: Mapping[str, str]) -> tuple[str, str] | None:
    """The images of a group `A/B`, or `A_B` in old files; None if it is not of two of these images."""
    if "/" in group:
        splits = [group.split("/", 1)]
    else:
        splits = [(group[:i], group[i + 1 :]) for i, letter in enumerate(group) if letter == "_"]
    found = [(by_key[a], by_key[b]) for a, b in splits if a in by_key and b in by_key and a != b]
    return found[0] if len(found) == 1 else None
