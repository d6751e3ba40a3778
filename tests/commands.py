"""Runs the command line in this process."""

import re
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from slimsfm.cli import run

_PROGRESS = re.compile(r"(?!slimsfm: ).+: (started$|\d+ of \d+|(done|stopped) after |running for )")


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str
    """Standard error without lines of progress."""


def slimsfm(*arguments: object) -> Outcome:
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        code = run([str(argument) for argument in arguments])
    return Outcome(code, out.getvalue(), "".join(f"{line}\n" for line in messages(err.getvalue())))


def messages(standard_error: str) -> list[str]:
    """The lines on standard error that are neither blank nor progress."""
    lines = [line for line in standard_error.splitlines() if line.strip()]
    return [line for line in lines if not _PROGRESS.match(line)]


def contents(folder: Path) -> dict[str, bytes | None]:
    """All paths in a folder: files with their bytes, folders with None."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def state(folder: Path) -> dict[str, tuple[int, int, bytes | None]]:
    """All paths in a folder, and the folder itself, with times and modes; files with their bytes."""
    paths = [folder, *sorted(folder.rglob("*"))]
    return {
        str(path.relative_to(folder)): (
            path.stat().st_mtime_ns,
            path.stat().st_mode,
            path.read_bytes() if path.is_file() else None,
        )
        for path in paths
    }
