"""Text and JSON files, read whole and within limits. Damage raises many errors: see `contents_of`."""

import json
import os
from pathlib import Path
from typing import Any

from slimsfm.limits import check_bytes, current_limits


def read_bytes(path: Path) -> bytes:
    """Read a file whole.

    Raises:
        InputError: The file is larger than the limit.
        OSError: It is missing or unreadable.
    """
    with path.open("rb") as file:
        check_bytes(path, os.fstat(file.fileno()).st_size)
        found = file.read(1 + int(current_limits().max_file_gb * 1e9))  # a device or a pipe states no size
    check_bytes(path, len(found))
    return found


def read_text(path: Path) -> str:
    """Read a text file in UTF-8, with or without a byte order mark.

    Raises:
        InputError, OSError: As in `read_bytes`.
        UnicodeDecodeError: The file is not text.
    """
    return read_bytes(path).decode("utf-8-sig")


def read_json(path: Path) -> Any:
    """Read a JSON file. Its numbers may be infinite or NaN; `plain` refuses those.

    Raises:
        InputError, OSError, UnicodeDecodeError: As in `read_text`.
        ValueError, RecursionError: The file is not JSON.
    """
    return json.loads(read_text(path))
