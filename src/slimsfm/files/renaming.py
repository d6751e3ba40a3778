"""Renames that no reader sees half done, and that replace nothing unasked.

Linux does both in one step. Where the file system cannot, a path is missing for a moment.
"""

import ctypes
import errno
import os
from pathlib import Path

_NOREPLACE, _EXCHANGE = 1, 2
_HERE = -100  # AT_FDCWD
_UNSUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP)


def exchange(a: Path, b: Path) -> None:
    """Exchange two files or folders of one file system.

    Raises:
        OSError: One of them is missing, or may not be renamed.
    """
    if _renameat2(a, b, _EXCHANGE):
        return
    kept = a.with_name(".exchanged")
    b.rename(kept)
    try:
        a.rename(b)
    except BaseException:  # an interruption as well
        kept.rename(b)
        raise
    kept.rename(a)


def rename_new(a: Path, b: Path) -> None:
    """Rename `a` to `b`, where nothing may be.

    Raises:
        FileExistsError: There is something.
        OSError: `a` may not be renamed.
    """
    if _renameat2(a, b, _NOREPLACE):
        return
    if os.path.lexists(b):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(b))
    a.rename(b)


def _renameat2(a: Path, b: Path, flag: int) -> bool:
    """Rename by the system call; False if system or file system has none."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    if call(_HERE, os.fsencode(a), _HERE, os.fsencode(b), flag) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(a), None, str(b))
