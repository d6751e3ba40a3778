"""What the commands share in checking outputs and printing."""

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import pycolmap
from rich.console import Console
from rich.text import Text

from slimsfm.cli.parsing import printable, with_flags
from slimsfm.errors import OutputError
from slimsfm.files import check_writable
from slimsfm.files.space import check_place
from slimsfm.mapping.georeference import Georeference
from slimsfm.mapping.map import Map

_WIDTH = 170  # of the widest table; a narrower terminal wraps lines, but no number is cut off


class _Console(Console):
    """Prints text as it is: names of files are neither markup nor emoji nor commands to the terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)

    def on_broken_pipe(self) -> None:
        """Leave it to the command line, as `print` does."""
        raise BrokenPipeError


console = _Console(highlight=False, markup=False, emoji=False, soft_wrap=True, width=_WIDTH)


def check_output(output: Path, *sources: Path | None, overwrite: bool, least_bytes: int = 0) -> None:
    """Check, before any work is done, that an output can be written and does not replace its sources.

    Raises:
        OutputError: The output exists and `overwrite` is off, it cannot be created, there is no room for
            `least_bytes`, or it is or contains a source, or lies in a map that is one.
    """
    for source in sources:
        if source is None:
            continue
        written, read = (Path(os.path.realpath(path)) for path in (output, source))
        if read.is_relative_to(written):
            raise OutputError(f"{output}: is or contains the input {source}; choose another output")
        if written.is_relative_to(read) and (read / "map.json").is_file():
            raise OutputError(f"{output}: lies in the map {source}; choose another output")
    check_writable(output, overwrite=overwrite)
    check_place(output, least_bytes=least_bytes)


class _WithFlags(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return with_flags(super().format(record))


def tidy_warnings() -> None:
    """Name options as flags in warnings of the library, and hide those of Pillow on damaged EXIF data."""
    warnings.filterwarnings("ignore", module="PIL")
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_WithFlags())


@contextmanager
def quiet() -> Iterator[None]:
    """Hide pycolmap's log messages, except fatal ones."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


class Stopwatch:
    """The seconds since its construction, as text."""

    def __init__(self) -> None:
        self._start = perf_counter()

    def __str__(self) -> str:
        return f"{perf_counter() - self._start:.1f} s"


def counts(map: Map) -> dict[str, int]:
    """Count the images, points and observations of a map."""
    return {
        "images": len(map.images),
        "points": len(map.point3D_ids),
        "observations": sum(len(seen.rows) for seen in map.observations.values()),
    }


def size(num_bytes: float | int) -> str:
    """Write a number of bytes in the largest fitting unit: B, kB, MB or GB."""
    for unit in ("B", "kB", "MB"):
        if num_bytes < 1000:
            return f"{num_bytes:.3g} {unit}" if num_bytes < 100 else f"{num_bytes:.0f} {unit}"
        num_bytes /= 1000
    return f"{num_bytes:.3g} GB"


def plural(number: int, one: str, many: str = "") -> str:
    """Write a number with its noun: 1 image, 2 images."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def place_of(georeference: Georeference) -> str:
    """Where on Earth a map is, as text."""
    latitude, longitude = georeference.latitude, georeference.longitude
    north = f"{abs(latitude):.6f}° {'N' if latitude >= 0 else 'S'}"
    east = f"{abs(longitude):.6f}° {'E' if longitude >= 0 else 'W'}"
    return f"{north}, {east}, height {georeference.height:.1f} m"


def finish(what: str, watch: Stopwatch, *next_command: Any) -> None:
    """Print what was made and how long it took, and the command to run next, if any."""
    console.print(f"{what} in {watch}")
    if next_command:
        console.print("next: slimsfm " + " ".join(str(word) for word in next_command), style="bold")


def print_notes(map: Map) -> None:
    """Print what was skipped, ignored or guessed when a map was made, and what contradicts it."""
    for note in map.info.notes:
        console.print(f"note: {with_flags(note)}", style="yellow")
    print_warnings(map)


def print_warnings(map: Map) -> None:
    """Print why a map is in doubt."""
    for warning in map.info.quality.warnings if map.info.quality else ():
        console.print(f"warning: {warning}", style="bold red")


def finish_map(made: Map, output: Path, watch: Stopwatch) -> None:
    """Print what a new map contains and how long it took, and how to reduce it."""
    print_notes(made)
    parts = ", ".join(plural(number, name.removesuffix("s")) for name, number in counts(made).items())
    finish(f"{output}: {parts}", watch, "reduce", output, "-o", f"{output}-small")
