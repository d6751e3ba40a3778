"""Tasks for other processes, which import them by name; attempts are counted in files."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Counted:
    """A task whose first attempts fail; a file counts the attempts."""

    number: int
    file: Path | None = None
    failures: int = 0


def square(number: int) -> int:
    return number * number


def raise_at_first(task: Counted) -> int:
    if _attempt(task) <= task.failures:
        raise ValueError(f"number {task.number} does not want to")
    return square(task.number)


def die_at_first(task: Counted) -> int:
    if _attempt(task) <= task.failures:
        os.kill(os.getpid(), signal.SIGKILL)
    return square(task.number)


def _attempt(task: Counted) -> int:
    if task.file is None:
        return 1
    with task.file.open("ab") as file:
        file.write(b".")
        return file.tell()
