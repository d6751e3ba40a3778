"""Arguments that commands share: where work and networks run, sizes and percentages."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from slimsfm.errors import InputError
from slimsfm.execution import OpenExecutor, dask_cluster, num_cores, processes
from slimsfm.reduction import ReductionLimits
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
        raise KeyboardInterrupt("run the same command again to resume") from interruption


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


_BYTES = {"": 1.0, "b": 1.0, "kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 2.0**10, "mib": 2.0**20, "gib": 2.0**30}


@dataclass(frozen=True, kw_only=True)
class LimitArguments:
    """Limits of the reduced map; the smallest choice within them is taken."""

    max_loss: str | None = None
    """Largest loss against the full map in percentage points, such as 1%. By default nothing may be lost, and
    twice as many points as that needs are kept."""

    max_bytes: str | None = None
    """Largest size on disk, such as 100kB."""

    max_ms: float | None = None
    """Longest time of matching and pose per query on this machine, in milliseconds."""

    max_points: int | None = None
    """Largest number of points."""

    max_images: int | None = None
    """Largest number of images, where images are kept."""

    def __post_init__(self) -> None:
        _ = self.limits  # raises on invalid values

    @property
    def limits(self) -> ReductionLimits:
        """The limits in plain numbers."""
        return ReductionLimits(
            max_loss=None if self.max_loss is None else parse_percent(self.max_loss, "max-loss"),
            max_bytes=None if self.max_bytes is None else parse_bytes(self.max_bytes, "max-bytes"),
            max_ms=self.max_ms,
            max_points=self.max_points,
            max_images=self.max_images,
        )


def parse_bytes(text: str, argument: str) -> float:
    """Read a size such as 100kB, 1.5 MB or 2MiB.

    Raises:
        InputError: The text is not a size.
    """
    return _parse(text, argument, _BYTES, "a size such as 100kB or 2MB")


def parse_percent(text: str, argument: str) -> float:
    """Read a percentage, with or without a percent sign.

    Raises:
        InputError: The text is not a percentage.
    """
    return _parse(text, argument, {"": 1.0, "%": 1.0}, "a percentage such as 1%")


def _parse(text: str, argument: str, units: dict[str, float], example: str) -> float:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-zA-Z%]*)\s*", text)
    if match is None or match[2].lower() not in units:
        raise InputError(f"{argument} must be {example}, got {text!r}")
    return float(match[1]) * units[match[2].lower()]
