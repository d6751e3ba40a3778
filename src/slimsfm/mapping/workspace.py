"""The intermediate files of a build, from which an interrupted one goes on.

    build.json           what the files are of: photos, options and versions; others start afresh
    extracted/*.npz      features and colors of a photo, a file each
    matched/*.npz        matches of a block of pairs, a file each; not of COLMAP's own matcher
    features.h5          all features, for reading
    database.db          COLMAP's database, with verified matches
    database.images      the images whose features the database holds
    sfm/                 models and their databases; never resumed

A file appears under its name when it is complete, so that a process may be killed at any moment.
"""

import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from slimsfm.files import remove
from slimsfm.files.resumable import KEY_FILE
from slimsfm.progress import ProgressBar

Array = np.ndarray

FEATURES, DATABASE, SFM = "features.h5", "database.db", "sfm"
_EXTRACTED, _MATCHED, _IMAGES = "extracted", "matched", "database.images"
_BLOCK = 20  # pairs of a file of matches
_LATEST = (FEATURES, DATABASE, f"{DATABASE}-shm", f"{DATABASE}-wal", _EXTRACTED, _MATCHED, _IMAGES)


class Workspace:
    """A folder of intermediate files."""

    def __init__(self, folder: Path, key: Mapping[str, Any]) -> None:
        """Use what a build of the same key left in a folder, and remove what another build left.

        Args:
            folder: The folder, which exists.
            key: All that features and matches depend on, as JSON values.
        """
        self.folder = folder
        text, path = json.dumps(key, sort_keys=True), folder / KEY_FILE
        if not path.is_file() or path.read_text() != text:
            for name in _LATEST:
                remove(folder / name)
            write_whole(path, text.encode())
        remove(folder / SFM)  # reconstruction starts afresh
        for name in (_EXTRACTED, _MATCHED):
            (folder / name).mkdir(exist_ok=True)

    def extracted(self, name: str) -> Path:
        """The file of the features of an image."""
        return self.folder / _EXTRACTED / f"{_digest(name)}.npz"

    def database(self, names: Sequence[str], write: Callable[[Path], None]) -> Path:
        """The database that holds the features of these images, with the matches so far, or a new one."""
        path, images, text = self.folder / DATABASE, self.folder / _IMAGES, json.dumps(list(names))
        if not (path.is_file() and images.is_file() and images.read_text() == text):
            images.unlink(missing_ok=True)
            for suffix in ("", "-shm", "-wal"):
                remove(Path(f"{path}{suffix}"))
            write(path)
            write_whole(images, text.encode())
        return path

    def match(
        self,
        pairs: Sequence[tuple[str, str]],
        match: Callable[[str, str], Array],
        progress: ProgressBar,
        label: str,
    ) -> dict[tuple[str, str], Array]:
        """Match pairs of images, without those that an interrupted build matched.

        Args:
            pairs: Pairs of names.
            match: Matches the images of two names; returns an array.
            progress: Progress callback, of the pairs that are matched now.
            label: What is done, for the progress.

        Returns:
            The result of `match` for each pair, in the order of the pairs.
        """
        blocks = [tuple(pairs[start : start + _BLOCK]) for start in range(0, len(pairs), _BLOCK)]
        files = {block: self.folder / _MATCHED / f"{_digest(block)}.npz" for block in blocks}
        found = {block: list(saved.values()) for block in blocks if (saved := load_arrays(files[block]))}
        left = [(block, pair) for block in blocks if block not in found for pair in block]
        done = len(pairs) - len(left)
        for block, pair in progress(left, resumed(label, done)):
            found.setdefault(block, []).append(match(*pair))
            if pair == block[-1]:
                save_arrays(files[block], {f"{i:04}": one for i, one in enumerate(found[block])})
        return {pair: one for block in blocks for pair, one in zip(block, found[block], strict=True)}


def resumed(label: str, done: int) -> str:
    """The label of work of which a part was done before an interruption."""
    return f"{label} ({done} done before)" if done else label


def save_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write arrays to a file that appears when it is complete."""
    with _whole(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_arrays(path: Path) -> dict[str, Array] | None:
    """Read arrays in the order in which they were written; None if the file is missing or damaged."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that appears when it is complete."""
    with _whole(path) as file:
        file.write(content)


@contextmanager
def _whole(path: Path) -> Iterator[BinaryIO]:
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        yield file
    os.replace(partial, path)


def _digest(value: Any) -> str:
    return sha256(json.dumps(value).encode()).hexdigest()[:32]
