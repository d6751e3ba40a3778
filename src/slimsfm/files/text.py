"""Text and JSON files: read whole, within limits, with errors that name the file."""

import json
from pathlib import Path
from typing import Any, NoReturn

from slimsfm.errors import InputError
from slimsfm.limits import check_bytes


def read_bytes(path: Path) -> bytes:
    """Read a file whole.

    Raises:
        InputError: The file is missing, too large or unreadable.
    """
    try:
        check_bytes(path, path.stat().st_size)
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:  # ValueError: the name has a null character
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error


def read_text(path: Path) -> str:
    """Read a text file in UTF-8, with or without a byte order mark.

    Raises:
        InputError: As in `read_bytes`, or the file is not text.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8 ({error.reason} at byte {error.start})") from error


def read_json(path: Path) -> Any:
    """Read a JSON file. Numbers that JSON does not know, such as NaN, are refused.

    Raises:
        InputError: As in `read_text`, or the file is not JSON.
    """
    text = read_text(path)
    try:
        return json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({error})") from error


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number")
