"""Folders for work in progress, which disappear with the process that works in them.

Each is locked by its process. A process that is killed cannot remove its folder, but loses the lock, and the
next one that looks removes the folder.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slimsfm.files.locks import locked

_PREFIX, _SUFFIX = ".slimsfm-", ".partial"


@contextmanager
def working_folder(parent: Path | None = None) -> Iterator[Path]:
    """A new folder, which is removed when the context ends; by default among the temporary files.

    Raises:
        OSError: The folder cannot be created.
    """
    while True:
        folder = Path(tempfile.mkdtemp(dir=parent, prefix=_PREFIX, suffix=_SUFFIX))
        with locked(folder) as held:
            if not held and not folder.exists():  # taken for abandoned before it was locked
                continue
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
            return


def remove_abandoned(parent: Path | None = None) -> None:
    """Remove the working folders in a folder whose process is gone; by default among the temporary files."""
    for folder in Path(parent or tempfile.gettempdir()).glob(f"{_PREFIX}*{_SUFFIX}"):
        with locked(folder) as held:
            if held and _is_ours(folder):
                shutil.rmtree(folder, ignore_errors=True)


def is_working_folder(name: str) -> bool:
    """Whether a name is that of a working folder."""
    return name.startswith(_PREFIX) and name.endswith(_SUFFIX)


def _is_ours(folder: Path) -> bool:
    try:
        return folder.lstat().st_uid == os.getuid() and not folder.is_symlink()
    except OSError:
        return False
