"""HDF5 files: read within what they can hold, or created so that they survive a full disk and interruptions.

Nothing outside a file is read: links, virtual datasets and external storage are refused. An array is
allocated only if the file can hold it, because HDF5 believes a damaged header that claims terabytes.
"""

import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import FileIO
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from h5py import h5l  # pyright: ignore[reportAttributeAccessIssue]

from slimsfm.errors import InputError
from slimsfm.files.interruption import uninterrupted
from slimsfm.limits import check_bytes

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_NUMBERS = "iufb"  # kinds of types that are read
_FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, h5py.h5z.FILTER_LZF)
_MAX_RATIO = 1100  # of unpacked to packed bytes; deflate reaches 1032
_SMALL_CHUNK = 250_000  # packed bytes that unpack to little, whatever they claim


def datasets_of(file: h5py.File) -> list[str]:
    """Names of all datasets, and of groups without any.

    Raises:
        ValueError: The file holds links to other names or files.
    """
    links: list[tuple[bytes, int]] = []
    file.id.links.visit(lambda name, link: links.append((name, link.type)), info=True)
    names = [name.decode() for name, _ in links]
    if followed := [name for name, (_, kind) in zip(names, links, strict=True) if kind != h5l.TYPE_HARD]:
        raise ValueError(f"{followed[0]!r} is a link, which is not followed")
    groups = {name.rpartition("/")[0] for name in names}
    return [name for name in names if name not in groups]


def groups_with(datasets: Iterable[str], part: str) -> list[str]:
    """Names of the groups that hold a dataset of this name, of the names that `datasets_of` gives."""
    end = f"/{part}"
    return [name.removesuffix(end) for name in datasets if name.endswith(end)]


def shape_and_type(file: h5py.File, name: str) -> tuple[tuple[int, ...], np.dtype]:
    """The shape of a dataset and the type of its numbers, without reading them.

    Raises:
        KeyError: There is none.
        ValueError: It holds no numbers, or not in this file.
    """
    found = _dataset(file, name)
    return found.shape, found.dtype


def read_array(file: h5py.File, name: str) -> np.ndarray:
    """Read a dataset of numbers, faster than `file[name][()]`.

    Raises:
        KeyError: There is none.
        ValueError: It holds no numbers, or not in this file, or claims more than the file can hold.
        InputError: It is larger than the limit.
        OSError: It is damaged.
    """
    found = _dataset(file, name)
    shape, kind = found.shape, found.dtype
    claimed = prod(shape) * kind.itemsize
    stored = min(found.get_storage_size(), file.id.get_filesize())
    if claimed > stored or found.get_offset() is None:
        _check_packed(found, claimed, stored)
    check_bytes("an array", claimed)
    values = np.empty(shape, kind)
    found.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def _dataset(file: h5py.File, name: str) -> h5py.h5d.DatasetID:
    try:
        found = h5py.h5d.open(file.id, name.encode())
    except TypeError as error:
        raise KeyError(f"{name} is not a dataset") from error
    if found.get_offset() is None:  # not in one piece in this file; the plan takes longer to ask for
        plan = found.get_create_plist()
        if plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count():
            raise ValueError(f"{name} lies in other files, which are not read")
    if found.dtype.kind not in _NUMBERS:
        raise ValueError(f"{name} does not hold numbers")
    return found


def _check_packed(found: h5py.h5d.DatasetID, claimed: int, stored: int) -> None:
    """Check that so many stored bytes can hold the claimed ones, unpacked."""
    plan = found.get_create_plist()
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    if unknown := set(filters).difference(_FILTERS):
        raise ValueError(f"it is packed by an unknown filter ({min(unknown)})")
    if plan.get_layout() == h5py.h5d.CHUNKED and stored:
        chunk = prod(plan.get_chunk()) * found.dtype.itemsize
        claimed = max(claimed, chunk)
        if h5py.h5z.FILTER_DEFLATE in filters and stored > _SMALL_CHUNK:
            _check_chunks(found, chunk)
    if claimed > stored * (_MAX_RATIO if filters else 1):
        raise ValueError(f"it claims {claimed} bytes, more than {stored} bytes of the file can hold")
    check_bytes("an array", claimed)


def _check_chunks(found: h5py.h5d.DatasetID, unpacked: int) -> None:
    """Check that large chunks unpack to their size: HDF5 unpacks whatever there is."""
    chunks: list[h5py.h5d.StoreInfo] = []
    found.chunk_iter(chunks.append)
    for chunk in chunks:
        if chunk.size > _SMALL_CHUNK:
            skipped, packed = found.read_direct_chunk(chunk.chunk_offset)
            if not skipped and len(zlib.decompressobj().decompress(packed, unpacked + 1)) > unpacked:
                raise ValueError(f"a chunk unpacks to more than its {unpacked} bytes")


@contextmanager
def creating(path: Path) -> Iterator[h5py.File]:
    """Create an HDF5 file, or replace it; a full disk raises OSError."""
    path.unlink(missing_ok=True)  # open readers keep the old file
    with _PatientFile(path, "w+b") as raw:
        file = None
        try:
            with uninterrupted():
                file = h5py.File(raw, "w", libver="latest")
            yield file
        finally:
            with uninterrupted():
                if file is not None:  # a deferred interruption may arrive before the assignment
                    file.close()
        if raw.failure:
            raise raw.failure


class _PatientFile(FileIO):
    """Records write errors instead of raising them, because HDF5 crashes the process if the disk is full."""

    failure: OSError | None = None

    def write(self, data: "ReadableBuffer", /) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and not self.failure:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.failure = error
        return size


def opened(path: Path) -> h5py.File:
    """Open an HDF5 file for reading.

    Raises:
        InputError: The file is missing or damaged.
    """
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is not a file")
    try:
        return h5py.File(path, "r")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except OSError as error:
        raise InputError(f"{path}: not a readable HDF5 file; it may be cut short") from error
