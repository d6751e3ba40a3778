"""The command line, run in this process."""

import re
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from slimsfm.cli import run

_PROGRESS = re.compile(r".+: (started|\d+ of \d+( in .* s|, .* left| after .* s)?|\w+ (after|for) [\d.]+ s)")


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str
    """Standard error without lines of progress."""
    progress: str
    """Lines of progress."""


def without_progress(err: str) -> str:
    """Standard error of a command without its lines of progress."""
    return "".join(line for line in err.splitlines(True) if not _PROGRESS.fullmatch(line.rstrip("\n")))


def slimsfm(*arguments: object) -> Outcome:
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        code = run([str(argument) for argument in arguments])
    said = err.getvalue()
    progress = "".join(line for line in said.splitlines(True) if _PROGRESS.fullmatch(line.rstrip("\n")))
    return Outcome(code, out.getvalue(), without_progress(said), progress)


def contents(folder: Path) -> dict[str, bytes | None]:
    """Everything below a folder: files with their bytes, folders with None."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }
