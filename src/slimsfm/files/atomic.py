"""Outputs that appear complete or not at all, whoever else writes or reads them."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from slimsfm.errors import InputError, OutputError, OutputExistsError, SlimsfmError
from slimsfm.files.locks import Identity, identity, locked
from slimsfm.files.renaming import exchange, rename_new
from slimsfm.files.working_folders import is_working_folder, remove_abandoned, working_folder

T = TypeVar("T")

_PATIENCE_S = 1.0  # for readers of what is to be replaced, who must begin again afterwards
_TRIES = 20


def check_writable(path: str | Path, *, overwrite: bool) -> None:
    """Check, before any work is done, that an output can be written.

    Raises:
        OutputExistsError: The output exists and `overwrite` is off.
        OutputError: The output is a device, or its parent is not a folder.
    """
    path = Path(path)
    try:
        if path.exists():
            if not overwrite:
                raise OutputExistsError(
                    f"{path}: exists already; choose another output or pass `overwrite=True`"
                )
            if not path.is_file() and not path.is_dir():
                raise OutputError(f"{path}: is neither a file nor a folder; choose another output")
        parent = existing_parent(path)
    except OSError as error:
        raise _cannot_write(path, error) from error
    if not parent.is_dir():
        raise OutputError(f"{path}: {parent} is not a folder, so nothing can be written there")


def existing_parent(path: Path) -> Path:
    """What exists nearest above an output, through links: its folder, if that exists."""
    parent = Path(os.path.realpath(path)).parent
    while not parent.exists():
        parent = parent.parent
    return parent


@contextmanager
def replacing(path: str | Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield a temporary path of the same name, which becomes `path` when the block succeeds.

    The block writes a file or a folder at the temporary path. If it fails or is interrupted, the temporary
    output is removed and `path` stays as it was. A link is kept, and what it points to is replaced.

    Raises:
        OutputExistsError: The output exists and `overwrite` is off, or another process wrote it meanwhile.
        OutputError: The output cannot be written, for example because the disk is full or read-only.
    """
    path = Path(path)
    check_writable(path, overwrite=overwrite)
    target = Path(os.path.realpath(path))
    try:
        before = identity(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(target.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error
    try:
        with working_folder(target.parent) as folder:
            yield folder / target.name
            _publish(folder / target.name, target, before)
    except OSError as error:
        if error.filename is not None and not _is_part(Path(str(error.filename)).absolute(), target):
            raise  # reading another file failed: the caller reports that
        raise _cannot_write(path, error) from error


def _is_part(file: Path, target: Path) -> bool:
    """Whether a file is an output, or lies in the working folder of one."""
    if not file.is_relative_to(target.parent) or file == target.parent:
        return False
    first = file.relative_to(target.parent).parts[0]
    return first == target.name or is_working_folder(first)


def _publish(new: Path, path: Path, before: Identity | None) -> None:
    """Put a new output in the place of the one that was there before, unless another has taken it."""
    with locked(path, wait_s=_PATIENCE_S):
        now = identity(path)
        if now not in (before, None):
            raise _lost(path)
        if now is None:
            try:
                rename_new(new, path)
            except FileExistsError as error:
                raise _lost(path) from error
            return
        exchange(new, path)
        if identity(new) != before:
            exchange(new, path)
            raise _lost(path)


def _lost(path: Path) -> OutputExistsError:
    return OutputExistsError(
        f"{path}: another process wrote it at the same time, and its output was kept; choose another output"
    )


def _cannot_write(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path}: cannot be written ({error.strerror or error}); nothing was kept")


def read_unchanged(folder: Path, read: Callable[[], T]) -> T:
    """Read a folder that other processes may replace, so that all that is read is of one version.

    Args:
        folder: The folder.
        read: Reads it and returns what it holds; called again if the folder was replaced meanwhile.

    Raises:
        InputError: The folder was replaced again and again.
    """
    if not os.path.exists(folder):  # not even under a name that can be
        return read()
    for _ in range(_TRIES):
        before = identity(folder)
        with locked(folder, shared=True, wait_s=_PATIENCE_S):
            if identity(folder) != before:
                continue
            try:
                found = read()
            except (SlimsfmError, OSError):
                if identity(folder) == before:
                    raise
                continue
            if identity(folder) == before:
                return found
    raise InputError(
        f"{folder}: other processes replaced it {_TRIES} times while it was read; try again later"
    )


def remove(path: str | Path) -> None:
    """Delete a file or folder if it exists; of a symbolic link, only the link."""
    path = Path(path)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
