"""Where long work is done, as options of a command."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from slimsfm.execution import OpenExecutor, dask_cluster, num_cores, processes


@dataclass(frozen=True, kw_only=True)
class Execution:
    """Where the work is done."""

    workers: int | None = None
    """Processes to use; one a core if not given, and 1 works in this one."""

    scheduler: str | None = None
    """A Dask cluster: the address of its scheduler (tcp://...), or "local" for one of this machine."""

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be at least 1, got {self.workers}")

    def open_executor(self) -> OpenExecutor | None:
        """How to open the means of execution; None: this process."""
        workers = self.workers or num_cores()
        if self.scheduler:
            address = None if self.scheduler == "local" else self.scheduler
            return partial(dask_cluster, address, workers)
        return None if workers == 1 else partial(processes, workers)


@contextmanager
def resumable() -> Iterator[None]:
    """Say of an interruption that what was done is not lost."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        raise KeyboardInterrupt("the same command goes on where it stopped") from interruption
