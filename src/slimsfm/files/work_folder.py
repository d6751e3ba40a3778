"""The hidden folder beside an output in which long work keeps what it has, so that it can be resumed."""

import errno
import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from slimsfm.errors import OutputError
from slimsfm.files.atomic import remove

RESUME = "run the same command again to resume"
"""What to say when work was interrupted that can be resumed."""

_LOCK = "lock"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)


@contextmanager
def work_folder(output: str | Path) -> Iterator[Path]:
    """Yield the folder `.NAME.build` beside an output NAME, which only this process uses meanwhile.

    It is removed in the end, also after an error. It stays, for the next call, if the block is interrupted
    (then the message of the `KeyboardInterrupt` says how to resume) or the process is killed.

    Raises:
        OutputError: Another process uses the folder, or it cannot be written.
    """
    output = Path(output)
    folder = output.absolute().parent / f".{output.name}.build"
    with ExitStack() as opened:
        try:
            created = _make(folder)
            is_locked = _lock(folder, opened)
            if is_locked is None:  # a file system without locks: nothing can be resumed
                remove(folder)
                folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="slimsfm-build-")))
        except OSError as error:
            raise OutputError(f"{output}: cannot be written ({error.strerror or error})") from error
        if is_locked is False:
            raise OutputError(
                f"{output}: another process is making it now; wait for that or choose another output"
            )
        keep = False
        try:
            yield folder
            created = []
        except KeyboardInterrupt as interruption:
            keep = is_locked is True and _holds_work(folder)
            if keep:
                raise KeyboardInterrupt(RESUME) from interruption
            raise
        except OSError as error:
            if error.errno in _FULL:
                raise OutputError(f"{output}: cannot be written ({error.strerror})") from error
            raise
        finally:
            if not keep:
                _remove(folder, created)


def _make(folder: Path) -> list[Path]:
    """Make a folder; returns the folders above it that were missing, the deepest first."""
    missing = [parent for parent in folder.parents if not parent.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing


def _lock(folder: Path, opened: ExitStack) -> bool | None:
    """Lock a folder until `opened` closes; False if another process has, None if that is impossible here."""
    while True:
        file = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        opened.callback(os.close, file)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            return None
        with suppress(FileNotFoundError):
            if os.path.sameopenfile(file, _reopened(folder, opened)):
                return True
        folder.mkdir(parents=True, exist_ok=True)  # its last user removed it in the meantime


def _reopened(folder: Path, opened: ExitStack) -> int:
    file = os.open(folder / _LOCK, os.O_RDONLY)
    opened.callback(os.close, file)
    return file


def _holds_work(folder: Path) -> bool:
    """Whether there is a file of some work, not only the lock and the folders and keys of its beginning."""
    return any(path.is_file() for path in folder.glob("*/*"))


def _remove(folder: Path, created: list[Path]) -> None:
    remove(folder)
    for parent in created:
        with suppress(OSError):  # others may have put something there
            parent.rmdir()
