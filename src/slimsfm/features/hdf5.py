"""HDF5 files: opened for reading alone, or created in a way that survives a full disk and an interruption."""

from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from slimsfm.errors import InputError
from slimsfm.files import uninterrupted

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


def read_array(file: h5py.File, name: str) -> np.ndarray:
    """Read a dataset, five times faster than `file[name][()]`; KeyError if there is none."""
    try:
        found = h5py.h5d.open(file.id, name.encode())
    except TypeError as error:
        raise KeyError(f"{name} is not a dataset") from error
    values = np.empty(found.shape, found.dtype)
    found.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def groups_with(file: h5py.File, dataset: str) -> list[str]:
    """Names of all groups that hold a dataset of this name."""
    found: list[str] = []

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Group) and dataset in item:
            found.append(name)

    file.visititems(visit)
    return found


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
    try:
        return h5py.File(path, "r")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except OSError as error:
        raise InputError(f"{path}: not a readable HDF5 file; it may be cut short") from error
