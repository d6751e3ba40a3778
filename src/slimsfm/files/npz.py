"""Files of arrays: npz without compression, and bytes packed by LZMA with a known largest size."""

import lzma
from io import BytesIO
from math import prod
from pathlib import Path
from zipfile import ZIP_STORED, ZipFile

import numpy as np

from slimsfm.limits import check_bytes

_LZMA_MEMORY = 256_000_000  # of the dictionary that the header asks for; the strongest preset takes 65 MiB


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file that `numpy.savez` wrote; they cannot be changed.

    No array is larger than its part of the file: compressed parts, objects and pickles are refused.

    Raises:
        InputError: The file is larger than the limit.
        Exception: Damage raises all kinds of errors: read inside `contents_of`.
    """
    if path.exists() and not path.is_file():
        raise ValueError("it is not a file")
    check_bytes(path, path.stat().st_size)
    with ZipFile(path) as archive:
        parts = archive.infolist()
        if any(one.compress_type != ZIP_STORED for one in parts):
            raise ValueError("its arrays are compressed; numpy.savez writes them without")
        return {one.filename.removesuffix(".npy"): _array(archive.read(one)) for one in parts}


def _array(data: bytes) -> np.ndarray:
    stream = BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    shape, is_fortran, kind = read_header(stream)
    if kind.hasobject or kind.fields:
        raise ValueError("it holds objects instead of numbers")
    if min(shape, default=0) < 0 or prod(shape) * kind.itemsize != len(data) - stream.tell():
        raise ValueError(f"{len(data) - stream.tell()} bytes do not hold an array of shape {shape}")
    return np.ndarray(shape, kind, data, stream.tell(), order="F" if is_fortran else "C")


def unpacked(packed: bytes, most: int) -> bytes:
    """Unpack at most this many bytes from what `lzma.compress` packed.

    Raises:
        ValueError: It holds more, or it is cut short.
        InputError: As many are more than the limit.
        lzma.LZMAError: It is damaged.
    """
    check_bytes("packed values", most)
    unpacker = lzma.LZMADecompressor(memlimit=_LZMA_MEMORY)
    found = unpacker.decompress(packed, max_length=most + 1)
    if len(found) > most or not unpacker.eof or unpacker.unused_data:
        raise ValueError(f"the packed values are cut short or hold more than {most} bytes")
    return found
