"""The hidden folder beside an output in which long work keeps what it has, so that it can be resumed."""

import errno
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from slimsfm.errors import OutputError
from slimsfm.files.atomic import remove
from slimsfm.files.locks import locked
from slimsfm.files.working_folders import working_folder

RESUME = "run the same command again to resume"
"""What to say when work was interrupted that can be resumed."""

KEY_FILE = "build.json"
"""The file that says what the work is of; the first that is written."""

_TRIES = 5
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)


@contextmanager
def resumable_folder(output: str | Path) -> Iterator[Path]:
    """Yield the folder `.NAME.build` beside an output NAME, which only this process uses meanwhile.

    It is removed in the end, also after an error. It stays, for the next call, if the block is interrupted
    (then the message of the `KeyboardInterrupt` says how to resume) or the process is killed. Where a file
    system has no locks, a temporary folder takes its place.

    Raises:
        OutputError: Another process uses the folder, or it cannot be written.
    """
    output = Path(output)
    folder = output.absolute().parent / f".{output.name}.build"
    missing = [parent for parent in folder.parents if not parent.exists()]
    with ExitStack() as opened:
        try:
            if not _claim(folder, opened, output):
                folder = opened.enter_context(working_folder())
        except OSError as error:
            raise OutputError(f"{output}: cannot be written ({error.strerror or error})") from error
        keep = False
        try:
            yield folder
            missing = []
        except KeyboardInterrupt as interruption:
            keep = _holds_work(folder)
            if keep:
                raise KeyboardInterrupt(RESUME) from interruption
            raise
        except OSError as error:
            if error.errno in _FULL:
                raise OutputError(f"{output}: cannot be written ({error.strerror})") from error
            raise
        finally:
            if not keep:
                _remove(folder, missing)


def _claim(folder: Path, opened: ExitStack, output: Path) -> bool:
    """Make and lock a folder until `opened` closes; False if its file system has no locks."""
    for _ in range(_TRIES):
        if _is_foreign(folder):
            raise OutputError(f"{folder}: is in the way and not what a build left there; rename or remove it")
        folder.mkdir(parents=True, exist_ok=True)
        held = opened.enter_context(locked(folder))
        if held is False:
            raise OutputError(
                f"{output}: another process is making it now; wait for that or choose another output"
            )
        if held or folder.exists():  # else its last user has removed it in the meantime
            return bool(held)
    return False


def _is_foreign(folder: Path) -> bool:
    """Whether there is something else: a link, a file, or a folder without the key of a build."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        return True
    names = [path.name for path in folder.iterdir()] if folder.exists() else []
    return bool(names) and not any(name.startswith(Path(KEY_FILE).stem) for name in names)


def _holds_work(folder: Path) -> bool:
    """Whether there is a file of some work, not only the folders and keys of its beginning."""
    return any(path.is_file() for path in folder.glob("*/*"))


def _remove(folder: Path, missing: list[Path]) -> None:
    remove(folder)
    for parent in missing:
        with suppress(OSError):  # others may have put something there
            parent.rmdir()
