"""Checksums of the files of a folder, which reveal damage that a reader could not notice.

CRC-32, as in zip and PNG files: made for accidents. It finds every damage of up to 32 bits in a row, and
misses one of four thousand million others. Nobody who means to deceive is kept from it.
"""

import json
import zlib
from dataclasses import dataclass
from pathlib import Path

from slimsfm.errors import InputError
from slimsfm.files.names import inside

COPY_AGAIN = "copy it again; if you changed it yourself, delete `checksums` from map.json"
"""What to do where a checksum differs."""

_BLOCK = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Checksum:
    """What a file is checked by."""

    bytes: int | None = None
    """Its size."""

    crc32: str
    """CRC-32 of its contents, eight hexadecimal digits."""


def checksum(path: Path) -> Checksum:
    """The checksum of a file."""
    value, size = 0, 0
    with path.open("rb", buffering=0) as file:
        while block := file.read(_BLOCK):
            value, size = zlib.crc32(block, value), size + len(block)
    return Checksum(bytes=size, crc32=f"{value:08x}")


def checksums_of(folder: Path) -> dict[str, Checksum]:
    """Checksums of all files in a folder and its subfolders, by path within it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): checksum(path) for path in files}


def check_files(folder: Path, stored: dict[str, Checksum]) -> None:
    """Check files of a folder by their checksums; files that have none are not checked.

    Raises:
        InputError: A file is missing or has other contents, or a path leads out of the folder.
    """
    for name, expected in stored.items():
        path = inside(folder, name)
        if not path.is_file():
            raise InputError(f"{path}: missing; {COPY_AGAIN}")
        found = checksum(path)
        if found.bytes != expected.bytes:
            raise InputError(f"{path}: damaged: {found.bytes} bytes, not {expected.bytes}; {COPY_AGAIN}")
        if found.crc32 != expected.crc32:
            raise InputError(f"{path}: damaged: its contents do not have the stored checksum; {COPY_AGAIN}")


def checksum_of_json(data: object) -> str:
    """CRC-32 of plain values, however a file spells them."""
    return f"{zlib.crc32(json.dumps(data, sort_keys=True).encode()):08x}"
