"""Locks between processes, on files and folders that exist.

A lock ends with its process, however that ends. Nobody is kept from a file by it: only processes that ask
respect it. A replaced file or folder is another one, and has a lock of its own.
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import NamedTuple

_PAUSE_S = 0.002


class Identity(NamedTuple):
    """What tells a file or folder from another one of the same path."""

    device: int
    inode: int


def identity(path: Path) -> Identity | None:
    """The identity of what is at a path; None if there is nothing."""
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return Identity(found.st_dev, found.st_ino)


@contextmanager
def locked(path: Path, *, shared: bool = False, wait_s: float = 0.0) -> Iterator[bool | None]:
    """Hold a lock on a file or folder within the context.

    Args:
        path: An existing file or folder.
        shared: Whether others may hold it as well, if they share it.
        wait_s: How long to wait for others, in seconds.

    Yields:
        Whether the lock is held; None if there is nothing at the path, or its file system has no locks.
    """
    end, held, descriptor = monotonic() + wait_s, None, None
    try:
        while held is None and (descriptor := _opened(path)) is not None:
            held = _lock(descriptor, fcntl.LOCK_SH if shared else fcntl.LOCK_EX, end)
            if held is None or _is_at(path, descriptor):
                break
            os.close(descriptor)  # replaced or removed in the meantime
            held = descriptor = None
        yield held
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _opened(path: Path) -> int | None:
    try:
        return os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None


def _is_at(path: Path, descriptor: int) -> bool:
    found = os.fstat(descriptor)
    return identity(path) == Identity(found.st_dev, found.st_ino)


def _lock(descriptor: int, kind: int, end: float) -> bool | None:
    while True:
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            if monotonic() >= end:
                return False
            sleep(_PAUSE_S)
        except OSError:
            return None
        else:
            return True
