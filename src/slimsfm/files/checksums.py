"""Checksums of the files of a folder, which reveal damage that a reader could not notice.

CRC-32, as in zip and PNG files: made for accidents. It finds every damage of up to 32 bits in a row, and
misses one of four thousand million others. Nobody who means to deceive is kept from it.
"""

import json
import zlib
from pathlib import Path
from typing import Any

from slimsfm.errors import InputError

COPY_AGAIN = "copy it again; if you changed it yourself, delete `checksums` from map.json"
"""What to do where a checksum differs."""

_BLOCK = 1 << 20


def checksum(path: Path) -> dict[str, Any]:
    """Size and CRC-32 of a file."""
    value, size = 0, 0
    with path.open("rb", buffering=0) as file:
        while block := file.read(_BLOCK):
            value, size = zlib.crc32(block, value), size + len(block)
    return {"bytes": size, "crc32": f"{value:08x}"}


def checksums_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Checksums of all files in a folder and its subfolders, by path within it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): checksum(path) for path in files}


def check_files(folder: Path, stored: dict[str, dict[str, Any]]) -> None:
    """Check files of a folder by their checksums; files that have none are not checked.

    Raises:
        InputError: A file is missing or has other contents.
    """
    for name, expected in stored.items():
        path = folder / name
        try:
            found = checksum(path)
        except FileNotFoundError as error:
            raise InputError(f"{path}: missing; {COPY_AGAIN}") from error
        if found["bytes"] != expected["bytes"]:
            raise InputError(
                f"{path}: damaged: {found['bytes']} bytes instead of {expected['bytes']}; {COPY_AGAIN}"
            )
        if found["crc32"] != expected["crc32"]:
            raise InputError(f"{path}: damaged: its contents do not have the stored checksum; {COPY_AGAIN}")


def checksum_of_json(data: object) -> str:
    """CRC-32 of plain values, however a file spells them."""
    return f"{zlib.crc32(json.dumps(data, sort_keys=True).encode()):08x}"
