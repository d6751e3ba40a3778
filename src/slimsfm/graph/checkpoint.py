"""Progress of long work on pairs of images, in a file that a crash at any moment leaves readable.

    KEY (64 characters) and a newline
    u, v (two little-endian 32-bit integers), error of v from u, of u from v (two 64-bit floats); and so on

Records are only ever appended. A file of another key is of other work and is begun anew; half a record at
the end is what a crash left, and is cut off.
"""

from contextlib import suppress
from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Float64, Int64

from slimsfm.errors import OutputError

_RECORD = np.dtype([("u", "<u4"), ("v", "<u4"), ("v_from_u", "<f8"), ("u_from_v", "<f8")])


class Checkpoint:
    """Remembers the errors of pairs, in a file that stays. Used as a context.

    Raises:
        OutputError: The file cannot be written.
    """

    def __init__(self, path: Path, key: str) -> None:
        self._path = path
        self._header = key.encode("ascii") + b"\n"
        self.pairs, self.errors = self._resume()

    def _resume(self) -> tuple[Int64[np.ndarray, "k 2"], Float64[np.ndarray, "k 2"]]:
        data = self._path.read_bytes() if self._path.exists() else b""
        if not data.startswith(self._header):
            data = self._begin()
        count = (len(data) - len(self._header)) // _RECORD.itemsize
        records = np.frombuffer(data, _RECORD, count, len(self._header))
        self._file = self._path.open("r+b")
        self._file.seek(len(self._header) + count * _RECORD.itemsize)
        self._file.truncate()
        pairs = np.stack([records["u"], records["v"]], axis=1).astype(np.int64)
        return pairs, np.stack([records["v_from_u"], records["u_from_v"]], axis=1)

    def _begin(self) -> bytes:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.write_bytes(self._header)
        except OSError as error:
            with suppress(OSError):
                self._path.unlink()
            raise self._failure(error) from error
        return self._header

    def _failure(self, error: OSError) -> OutputError:
        return OutputError(f"{self._path}: cannot be written ({error.strerror or error})")

    def __enter__(self) -> "Checkpoint":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # of what `append` has told already
            self._file.close()

    def append(self, pairs: Int64[np.ndarray, "k 2"], errors: Float64[np.ndarray, "k 2"]) -> None:
        """Add what was found for some pairs."""
        records = np.empty(len(pairs), _RECORD)
        records["u"], records["v"] = pairs.T
        records["v_from_u"], records["u_from_v"] = errors.T
        try:
            self._file.write(records.tobytes())
            self._file.flush()
        except OSError as error:
            raise self._failure(error) from error
