"""`slimsfm reduce`."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Execution
from slimsfm.cli.options import Advanced, Flags, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish
from slimsfm.cli.tables import (
    kept_graph,
    print_change,
    print_dominating_set,
    print_speed,
    promise,
    read_reducible,
)
from slimsfm.errors import InputError
from slimsfm.mapping.io import read_map, write_map
from slimsfm.progress import shown
from slimsfm.reduction import (
    Conditions,
    ImageOptions,
    ReduceOptions,
    ReductionLimits,
    repeated_options,
    with_parent,
)
from slimsfm.reduction import reduce as reduce_map
from slimsfm.reduction.reduced import Use

_BYTES = {"": 1.0, "b": 1.0, "kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 2.0**10, "mib": 2.0**20, "gib": 2.0**30}


@dataclass(frozen=True, kw_only=True)
class LimitArguments:
    """Limits of the reduced map; the smallest choice within them is taken."""

    max_loss: str | None = None
    """Largest loss against the full map in percentage points, such as 1%. By default nothing may be lost, and
    twice as many points as that needs are kept, or more for blurred and half hidden queries."""

    max_median_factor: float | None = None
    """How many times as large as the full map's the median corner error may be. By default 1.5 if possible,
    unless max-loss or max-error is given."""

    max_p90_factor: float | None = None
    """The same for the 90th percentile of the corner error. By default 2 if possible, as above."""

    max_error: str | None = None
    """Largest corner error, as the 90th percentile that is predicted: in map units, which are meters if the
    map's unit is metre, such as 0.05, or relative to the diagonal d of the box, such as 0.01d."""

    max_bytes: str | None = None
    """Largest size on disk, such as 100kB."""

    max_ms: float | None = None
    """Longest time of a whole query on this machine, from decoded pixels to pose, in milliseconds."""

    max_points: int | None = None
    """Largest number of points."""

    max_images: int | None = None
    """Largest number of images, where images are kept."""

    def __post_init__(self) -> None:
        _ = self.limits  # raises on invalid values

    @property
    def limits(self) -> ReductionLimits:
        """The limits in plain numbers."""
        in_units, in_diagonals = (
            (None, None) if self.max_error is None else parse_length(self.max_error, "max-error")
        )
        return ReductionLimits(
            max_loss=None if self.max_loss is None else parse_percent(self.max_loss, "max-loss"),
            max_median_factor=self.max_median_factor,
            max_p90_factor=self.max_p90_factor,
            max_error=in_units,
            max_relative_error=in_diagonals,
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


def parse_length(text: str, argument: str) -> tuple[float | None, float | None]:
    """Read a length in map units, or in diagonals of the box with a suffix d; the other one is None.

    Raises:
        InputError: The text is not a length.
    """
    value = _parse(text, argument, {"": 1.0, "d": 1.0}, "a length such as 0.05 or 0.01d")
    return (None, value) if text.strip().lower().endswith("d") else (value, None)


def _parse(text: str, argument: str, units: dict[str, float], example: str) -> float:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-zA-Z%]*)\s*", text)
    if match is None or match[2].lower() not in units:
        raise InputError(f"{argument} must be {example}, got {text!r}")
    return float(match[1]) * units[match[2].lower()]


@dataclass(frozen=True, kw_only=True)
class ReduceArguments:
    """How to choose what is kept."""

    for_: Annotated[Use | None, Flags(("--for",))] = None
    """Match queries with points (direct), with images (images), or with either (both). By default images if
    an option below chooses images, else direct. With both, limits hold for each part."""

    selector: str | None = None
    """Selector of the points: information, kcover or random. By default the first two are compared."""

    limits: LimitArguments = LimitArguments()
    """Limits of the reduced map."""

    image_choice: ImageOptions = ImageOptions()
    """How images are chosen."""

    conditions: Conditions = "rough"
    """Queries that losses are predicted for: only some as clean as the map's photos (clean), or blurred and
    partly hidden ones too (rough), for which more points are kept where they need them."""

    seed: int = 0
    """Seed of all random choices."""

    def __post_init__(self) -> None:
        _ = self.options  # raises on invalid values and contradictions

    @property
    def options(self) -> ReduceOptions:
        """The options of the library."""
        return ReduceOptions(
            for_=self.for_,
            selector=self.selector,
            limits=self.limits.limits,
            image_choice=self.image_choice,
            conditions=self.conditions,
            seed=self.seed,
        )


def reduce(
    map: MapPath,
    /,
    output: OutputPath,
    choosing: ReduceArguments = ReduceArguments(),
    as_: Annotated[Path | None, Flags(("--as",))] = None,
    execution: Annotated[Execution, Advanced()] = Execution(),
    overwrite: bool = False,
) -> None:
    """Make a map small, and say what that costs.

    Many ways are tried on the map's own images, each left out in turn, and the smallest that loses nothing is
    taken; `slimsfm frontier` lists them all. A dominating set of images is kept of a map that was built
    without a detector.

    Args:
        map: The full map.
        output: Where to write the reduced map.
        choosing: How to choose what is kept.
        as_: A reduced map: choose as when it was made, from a smaller map, and by no other option.
        execution: Where the reference graph is computed.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    check_output(output, map, choosing.image_choice.graph, overwrite=overwrite)
    if as_ is not None and choosing != ReduceArguments():
        raise InputError("as repeats a reduction, so no option can say how to choose what is kept")
    full, options = read_reducible(map), choosing.options
    if as_ is not None:
        options = repeated_options(read_map(as_), as_, full)
    full = with_parent(full, map, output, options)
    reduced = reduce_map(full, options, graph=kept_graph(map, execution), progress=shown)
    write_map(reduced.map, output, overwrite=overwrite)
    for note in reduced.notes:
        console.print(f"note: {note}")
    print_dominating_set(reduced, options)
    print_change(map, full, output, reduced.map)
    for one in reduced.forecast.values():
        console.print(f"{one.choice.method} ({one.choice.detail}): {promise(map, full, one)}")
    print_speed(full, reduced.map)
    finish(f"{output}: written", watch, "localize", output, "IMAGES", "-o", "poses.json")
