"""Atomic writes: a file or folder appears complete or not at all."""

import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType

from slimsfm.errors import OutputError, OutputExistsError


def check_writable(path: str | Path, *, overwrite: bool) -> None:
    """Check, before any work is done, that an output can be written.

    Raises:
        OutputExistsError: The output exists and `overwrite` is off.
        OutputError: The parent of the output is not a folder.
    """
    path = Path(path)
    try:
        if path.exists() and not overwrite:
            raise OutputExistsError(f"{path}: exists already; choose another output or pass `overwrite=True`")
        parent = path.absolute().parent
        while not parent.exists():
            parent = parent.parent
    except OSError as error:
        raise _cannot_write(path, error) from error
    if not parent.is_dir():
        raise OutputError(f"{path}: {parent} is not a folder, so nothing can be written there")


@contextmanager
def replacing(path: str | Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield a temporary path next to `path`, and rename it to `path` when the block succeeds.

    The block writes a file or a folder at the temporary path. If it fails or is interrupted, the temporary
    output is removed and `path` stays as it was.

    Raises:
        OutputExistsError: The output exists and `overwrite` is off.
        OutputError: The output cannot be written, for example because the disk is full or read-only.
    """
    path = Path(path)
    check_writable(path, overwrite=overwrite)
    partial = path.absolute().parent / f".{path.name}.partial"
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        remove(partial)
    except OSError as error:
        raise _cannot_write(path, error) from error
    try:
        yield partial
        _swap(partial, path)
    except OSError as error:
        if error.filename is not None and not Path(str(error.filename)).absolute().is_relative_to(partial):
            raise  # reading another file failed: the caller reports that
        raise _cannot_write(path, error) from error
    finally:
        remove(partial)


def _cannot_write(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path}: cannot be written ({error.strerror or error}); nothing was kept")


def _swap(partial: Path, path: Path) -> None:
    old = partial.with_suffix(".old")
    remove(old)
    try:
        if path.exists():
            path.rename(old)
        partial.rename(path)
    except BaseException:  # restore the old output after an interruption as well
        if old.exists() and not path.exists():
            old.rename(path)
        raise
    remove(old)


def remove(path: str | Path) -> None:
    """Delete a file or folder if it exists; of a symbolic link, only the link."""
    path = Path(path)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the block ends, because some C code swallows the exceptions."""
    if current_thread() is not main_thread():
        yield
        return
    delayed: list[tuple[int, FrameType | None]] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    ours = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in ours:
        signal.signal(number, lambda number, frame: delayed.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
    for number, frame in delayed[:1]:
        ours[signal.Signals(number)](number, frame)
