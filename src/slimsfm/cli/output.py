"""What the commands share in parsing and printing."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from functools import partial, wraps
from io import StringIO
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, TypeVar

import pycolmap
import tyro
from rich.console import Console

from slimsfm.errors import InputError, OutputError
from slimsfm.files import check_writable
from slimsfm.mapping.map import Map

Result = TypeVar("Result")

Flat = tyro.conf.OmitArgPrefixes
"""Annotates options whose fields are options of the command itself."""

OutputPath = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
"""Where the result goes."""

MapPath = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
ImagesPath = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES")]
ModelPath = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL")]

_WIDTH = 170  # of the widest table; narrower terminals wrap lines themselves, which cuts no figure off

console = Console(highlight=False, soft_wrap=True, width=_WIDTH)


def parse(command: Callable[..., Result], arguments: Sequence[str], kind: str = "") -> Result:
    """Call a command with what the arguments say; its signature is the command line.

    Args:
        command: Lies in the module of its name.
        arguments: What stands after the command's name, and its kind.
        kind: Which of the kinds that the command has.

    Raises:
        InputError: An argument is missing, unknown or of a value that its options refuse.
    """
    name = f"{command.__module__.rpartition('.')[2].removesuffix('_command')} {kind}".strip()

    @wraps(command)
    def bound(*args: Any, **kwargs: Any) -> Callable[[], Result]:
        return partial(command, *args, **kwargs)

    config = (tyro.conf.FlagCreatePairsOff,)
    with redirect_stderr(StringIO()) as said:
        try:
            call = tyro.cli(bound, prog=f"slimsfm {name}", args=list(arguments), config=config)
        except SystemExit as end:
            if not end.code:
                raise  # --help
            raise InputError(f"{_in_one_line(said.getvalue())}; see slimsfm {name} --help") from None
    return call()


def _in_one_line(boxed: str) -> str:
    """What stands in tyro's box below its title, without the name that our functions give to options."""
    parts = re.split(r".*(?:─{4}|-{4}).*\n", boxed)
    message = " ".join(line.strip("│ ") for line in parts[min(1, len(parts) - 1)].splitlines())
    return re.sub(r"^Error parsing [a-z][\w.]*: ", "", message.strip().rstrip("."))


def check_output(output: Path, source: Path, *, overwrite: bool) -> None:
    """Refuse, before any work is done, an output that cannot be written or would replace what it is made of.

    Raises:
        OutputError: It exists and `overwrite` is off, has no folder to lie in, or is or holds the source.
    """
    if source.resolve().is_relative_to(output.resolve()):
        raise OutputError(f"{output}: is or holds the input {source}; choose another output")
    check_writable(output, overwrite=overwrite)


@contextmanager
def quiet() -> Iterator[None]:
    """Keep pycolmap's log, but for fatal messages, off the terminal."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


class Stopwatch:
    """Seconds since it was made."""

    def __init__(self) -> None:
        self._start = perf_counter()

    def __str__(self) -> str:
        return f"{perf_counter() - self._start:.1f} s"


def counts(map: Map) -> dict[str, int]:
    """Images, points and observations of a map."""
    return {
        "images": len(map.images),
        "points": len(map.point3D_ids),
        "observations": sum(len(seen.rows) for seen in map.observations.values()),
    }


def size(num_bytes: float | int) -> str:
    """Bytes for a human reader."""
    for unit in ("B", "kB", "MB"):
        if num_bytes < 1000:
            return f"{num_bytes:.3g} {unit}" if num_bytes < 100 else f"{num_bytes:.0f} {unit}"
        num_bytes /= 1000
    return f"{num_bytes:.3g} GB"


def finish(what: str, watch: Stopwatch, *next_command: Any) -> None:
    """Say what was made, what it took, and what to do next."""
    console.print(f"{what} in {watch}")
    if next_command:
        console.print("next: slimsfm " + " ".join(str(word) for word in next_command), style="bold")


def finish_map(made: Map, output: Path, watch: Stopwatch) -> None:
    """Say what map was made, what it took, and that it can be reduced."""
    parts = ", ".join(f"{number} {name}" for name, number in counts(made).items())
    finish(f"{output}: {parts}", watch, "reduce", output, "-o", f"{output}-small")
