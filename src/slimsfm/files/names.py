"""Names from files that become paths stay inside their folder."""

import os
from pathlib import Path, PurePosixPath

from slimsfm.errors import InputError

_MOST_BYTES = 255  # of a name in a folder


def inside(folder: Path, name: str) -> Path:
    """The path of a name inside a folder: for every name that comes from a file and becomes a path.

    The name may lead through subfolders. Links in the folder are followed, because they are the user's.

    Raises:
        InputError: The name is empty, absolute or leads out of the folder, or no file can have it.
    """
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\0" in name or _longest(parts) > _MOST_BYTES:
        raise InputError(
            f"{name!r}: must be a name inside {folder}, not empty, not absolute, without '..'; rename it"
        )
    return folder / name


def _longest(parts: tuple[str, ...]) -> int:
    return max(len(os.fsencode(part)) for part in parts)
