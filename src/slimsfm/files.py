"""Writing: a result appears whole or not at all."""

import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType

from slimsfm.errors import OutputError


def check_writable(path: Path, *, overwrite: bool) -> None:
    """Refuse, before any work is done, an output that exists or has no folder to lie in.

    Raises:
        OutputError: The output exists and `overwrite` is off, or its parent is not a folder.
    """
    try:
        if path.exists() and not overwrite:
            raise OutputError(f"{path}: exists already; choose another output or pass `overwrite=True`")
        parent = path.absolute().parent
        while not parent.exists():
            parent = parent.parent
    except OSError as error:
        raise _cannot_write(path, error) from error
    if not parent.is_dir():
        raise OutputError(f"{path}: {parent} is not a folder, so nothing can be written there")


@contextmanager
def replacing(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Give a temporary path beside `path`, and rename it to `path` when the block ends well.

    The block makes a file or a folder at the temporary path. When it fails or is interrupted, what it wrote
    is removed and whatever stood at `path` still does.

    Raises:
        OutputError: The output cannot be written: it exists, or the disk is full or read-only.
    """
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
            raise  # reading something else failed: not ours to explain
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
    except BaseException:  # an interruption, too, must not leave the place empty
        if old.exists() and not path.exists():
            old.rename(path)
        raise
    remove(old)


def remove(path: Path) -> None:
    """Delete a file or folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Put off Ctrl-C and SIGTERM until the block ends, for C code that would swallow what they raise."""
    if current_thread() is not main_thread():
        yield
        return
    put_off: list[tuple[int, FrameType | None]] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    ours = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in ours:
        signal.signal(number, lambda number, frame: put_off.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
    for number, frame in put_off[:1]:
        ours[signal.Signals(number)](number, frame)
