"""The intermediate files of a build, from which an interrupted one goes on.

    build.json           what the files are of: photos, options and versions; others start afresh
    extracted/*.npz      features and colors of a photo, a file each
    matched/*.npz        matches of a block of pairs, a file each
    features.h5          all features, for reading
    database.db          COLMAP's database, with verified matches; written afresh
    sfm/                 models and their databases; never resumed

A file appears under its name when it is complete, so that a process may be killed at any moment.
"""

import json
import os
import zipfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from slimsfm.files import remove, working_folder
from slimsfm.files.resumable import KEY_FILE
from slimsfm.progress import ProgressBar, counted

Arrays = dict[str, np.ndarray]

Block = list[tuple[str, str]]
"""Pairs of names that are matched together."""

FEATURES, DATABASE, SFM = "features.h5", "database.db", "sfm"
_EXTRACTED, _MATCHED = "extracted", "matched"
_BLOCK = 10  # pairs of a file of matches: about a second of work
_LATEST = (FEATURES, DATABASE, f"{DATABASE}-shm", f"{DATABASE}-wal", _EXTRACTED, _MATCHED)


@contextmanager
def opened_workspace(folder: str | Path | None) -> Iterator[Path]:
    """A folder, made if it is missing, or a temporary one. Open files stay readable after that is removed."""
    if folder is None:
        with working_folder() as temporary:
            yield temporary
    else:
        Path(folder).mkdir(parents=True, exist_ok=True)
        yield Path(folder)


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

    def in_blocks(
        self,
        pairs: Sequence[tuple[str, str]],
        solve: Callable[[Sequence[Block]], Generator[Arrays, None, None]],
        progress: ProgressBar,
        label: str,
    ) -> list[tuple[Block, Arrays]]:
        """Do work on blocks of pairs of images, without those that an interrupted build did.

        Args:
            pairs: Pairs of names.
            solve: Does the work; yields the result of each block, in order.
            progress: Progress callback, of the pairs that are left.
            label: What is done, for the progress.

        Returns:
            All blocks and their results, in the order of the pairs.
        """
        blocks = [list(pairs[start : start + _BLOCK]) for start in range(0, len(pairs), _BLOCK)]
        files = [self.folder / _MATCHED / f"{_digest(block)}.npz" for block in blocks]
        found = [load_arrays(file) for file in files]
        left = [row for row, arrays in enumerate(found) if arrays is None]
        done = len(pairs) - sum(len(blocks[row]) for row in left)
        with (
            counted(progress, len(pairs) - done, resumed(label, done)) as advance_to,
            closing(solve([blocks[row] for row in left])) as solved,
        ):
            solved_pairs = 0
            for row, arrays in zip(left, solved, strict=True):
                save_arrays(files[row], arrays)
                found[row] = arrays
                solved_pairs += len(blocks[row])
                advance_to(solved_pairs)
        return [(block, arrays) for block, arrays in zip(blocks, found, strict=True) if arrays]


def resumed(label: str, done: int) -> str:
    """The label of work of which a part was done before an interruption."""
    return f"{label} ({done} done before)" if done else label


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to a file that appears when it is complete."""
    with _whole(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_arrays(path: Path) -> Arrays | None:
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
