"""`slimsfm reduce`."""

from dataclasses import dataclass
from typing import Annotated

from slimsfm.cli.arguments import Execution, LimitArguments
from slimsfm.cli.options import Advanced, Flags, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish
from slimsfm.cli.tables import kept_graph, print_change, print_dominating_set, promise, read_reducible
from slimsfm.mapping.io import write_map
from slimsfm.progress import shown
from slimsfm.reduction import ImageOptions, ReduceOptions
from slimsfm.reduction import reduce as reduce_map
from slimsfm.reduction.reduced import Use


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
            seed=self.seed,
        )


def reduce(
    map: MapPath,
    /,
    output: OutputPath,
    choosing: ReduceArguments = ReduceArguments(),
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
        execution: Where the reference graph is computed.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    check_output(output, map, overwrite=overwrite)
    full, options = read_reducible(map), choosing.options
    reduced = reduce_map(full, options, graph=kept_graph(map, execution), progress=shown)
    write_map(reduced.map, output, overwrite=overwrite)
    for note in reduced.notes:
        console.print(f"note: {note}")
    print_dominating_set(reduced, options)
    print_change(map, full, output, reduced.map)
    for one in reduced.forecast.values():
        console.print(f"{one.choice.method} ({one.choice.detail}): {promise(map, full, one)}")
    finish(f"{output}: written", watch, "localize", output, "IMAGES", "-o", "poses.json")
