"""Options of commands: where the work runs."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from slimsfm.execution import OpenExecutor, dask_cluster, num_cores, processes


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
        raise KeyboardInterrupt("run the same command again to resume") from interruption
