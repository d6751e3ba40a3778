"""Whether an output can be written where the user asked, found out by trying, before the work."""

import shutil
import tempfile
from pathlib import Path

from slimsfm.errors import OutputError
from slimsfm.files.atomic import existing_parent

_LEAST = 4096  # bytes of the smallest output, a block of most file systems


def check_place(path: str | Path, *, least_bytes: int = 0) -> None:
    """Check that an output can be created and that there is room for it.

    A file is created and removed in its folder or, if that does not exist, in the nearest one above: what a
    file system says about permissions is wrong for administrators and on network drives.

    Args:
        path: The output, a file or a folder.
        least_bytes: Bytes that it needs in any case.

    Raises:
        OutputError: It cannot be written.
    """
    path = Path(path)
    try:
        parent = existing_parent(path)
        with tempfile.NamedTemporaryFile(dir=parent, prefix=".slimsfm-"):
            pass
        usage = shutil.disk_usage(parent)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
    needed = max(least_bytes, _LEAST)
    if usage.total and usage.free < needed:
        raise OutputError(
            f"{path}: No space left on device: {_megabytes(usage.free)} are free, about {_megabytes(needed)} "
            "are needed; choose another output or make room"
        )


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.3g} MB"
