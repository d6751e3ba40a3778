"""Arguments that commands share: where work and networks run, and what is read."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from slimsfm.execution import OpenExecutor, dask_cluster, num_cores, processes
from slimsfm.files.resumable import RESUME
from slimsfm.limits import Limits, use_limits
from slimsfm.weights import Runtime, use_runtime


@dataclass(frozen=True, kw_only=True)
class Execution:
    """Processes or machines that share the work."""

    workers: int | None = None
    """Number of worker processes, by default the number of cores. 1 starts no other process."""

    scheduler: str | None = None
    """Address of the scheduler of a Dask cluster (tcp://...), or `local` to start one on this machine."""

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be at least 1, got {self.workers}")

    def open_executor(self) -> OpenExecutor | None:
        """Return a function that opens the executor; None if the work runs in this process."""
        workers = self.workers or num_cores()
        if self.scheduler:
            address = None if self.scheduler == "local" else self.scheduler
            return partial(dask_cluster, address, workers)
        return None if workers == 1 else partial(processes, workers)


@contextmanager
def resumable() -> Iterator[None]:
    """Add to an interruption that finished work is saved."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        raise KeyboardInterrupt(RESUME) from interruption


@dataclass(frozen=True, kw_only=True)
class Networks:
    """Weights and device of learned methods."""

    weights: Path | None = None
    """Folder of weight files; by default $SLIMSFM_WEIGHTS, then the caches of the libraries."""

    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where networks run; `auto` takes a GPU if there is one. The default is $SLIMSFM_DEVICE."""

    def apply(self) -> None:
        """Use these for all networks of the command, including those in its worker processes.

        Raises:
            InputError: The folder does not exist.
        """
        use_runtime(Runtime.from_environment(self.weights, self.device))


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Limits on what is read."""

    max_megapixels: float | None = None
    """Largest image that is read, by default $SLIMSFM_MAX_MEGAPIXELS, else 120, which take 1 GB of memory."""

    def apply(self) -> None:
        """Use these for all files that the command reads, also in its worker processes.

        Raises:
            InputError: A limit is not a positive number.
        """
        use_limits(Limits.from_environment(self.max_megapixels))
