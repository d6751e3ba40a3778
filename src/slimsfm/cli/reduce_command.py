"""`slimsfm reduce`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from slimsfm.cli.choices import print_change, promise
from slimsfm.cli.execution import Execution
from slimsfm.cli.image_choice import ByImages
from slimsfm.cli.limits import Limits
from slimsfm.cli.options import Advanced, Flags, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish
from slimsfm.errors import InputError
from slimsfm.features.methods import DETECTOR_FREE
from slimsfm.mapping.direct import with_points
from slimsfm.mapping.io import read_map, weigh_map, write_map
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.progress import shown
from slimsfm.reduction import Candidate, FrontierOptions, Maker, frontier, recommend, try_images
from slimsfm.selection import SELECTORS

Use = Literal["direct", "images", "both"]


@dataclass(frozen=True, kw_only=True)
class Choosing:
    """How what is kept is chosen."""

    for_: Annotated[Use, Flags(("--for",))] = "direct"
    """Match queries with points (direct), with images (images), or either way (both); limits then hold for
    each of the two parts."""

    selector: str | None = None
    """Let this one choose the points: information, kcover, probabilistic or random."""

    limits: Limits = Limits()
    """What the slim map must keep to."""

    by: ByImages = ByImages()
    """How images are chosen."""

    seed: int = 0
    """Seed of every random choice."""

    def __post_init__(self) -> None:
        if self.selector is not None and self.selector not in SELECTORS:
            raise ValueError(f"selector must be one of {', '.join(SELECTORS)}, got {self.selector!r}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if self.selector is not None and "direct" not in self.uses:
            raise ValueError("selector chooses points, but only images are to be kept; see --for")
        if self.by.is_given and "direct" not in self.uses and self.limits != Limits():
            raise ValueError("images and random leave nothing to choose: limits do not go with them")

    @property
    def uses(self) -> tuple[str, ...]:
        """What the slim map is for; images alone where only images are spoken of."""
        if self.for_ == "both":
            return ("direct", "images")
        return ("images",) if self.by.is_wanted else (self.for_,)


def reduce(
    map: MapPath,
    /,
    output: OutputPath,
    choosing: Choosing = Choosing(),
    execution: Annotated[Execution, Advanced()] = Execution(),
    overwrite: bool = False,
) -> None:
    """Make a map small, and say what that costs.

    Many ways are tried on the map's own images, each left out in turn, and the smallest that loses nothing is
    taken; `slimsfm frontier` lists them all. Of a map built without a detector a dominating set is kept.

    Args:
        map: A map.
        output: Where the slim map is written.
        choosing: How what is kept is chosen.
        execution: Where the reference graph is computed.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    check_output(output, map, overwrite=overwrite)
    full = read_map(map)
    check_has_features(full)
    if len(full.images) < 2:
        raise InputError(f"{map}: has one image; there is nothing to reduce")
    if full.info.extractor in DETECTOR_FREE and not choosing.by.is_wanted:  # there are no points to match
        choosing = replace(choosing, by=replace(choosing.by, solver="exact"))
    chosen = _chosen(full, map, choosing, execution)
    slim = _slim(full, chosen)
    write_map(slim, output, overwrite=overwrite)
    print_change(map, full, output, slim)
    for one in chosen.values():
        console.print(f"{one.choice.method} ({one.choice.detail}): {promise(map, full, one)}")
    finish(f"{output}: written", watch, "localize", output, "IMAGES", "-o", "poses.json")


def _chosen(full: Map, path: Path, choosing: Choosing, execution: Execution) -> dict[str, Candidate]:
    """What is chosen for each use."""
    by, wish = choosing.by, choosing.limits.wish
    chosen: dict[str, Candidate] = {}
    if by.is_wanted:
        names = by.choose(full, path, wish, choosing.seed, execution)
        chosen["images"] = try_images(full, names, weigh_map, shown)
    compared = tuple(use for use in choosing.uses if use not in chosen)
    if compared:
        options = FrontierOptions(uses=compared, seed=choosing.seed)
        if choosing.selector:
            options = replace(options, selectors=(choosing.selector,))
        if wish.max_points:
            options = replace(options, budgets=(*options.budgets, wish.max_points))
        graph = by.load_or_compute_graph(full, path, execution) if "images" in compared else None
        found = frontier(full, graph, weigh_map, options, shown)
        chosen |= {use: recommend(found, use, wish) for use in compared}
    return chosen


def _slim(full: Map, chosen: dict[str, Candidate]) -> Map:
    maker = Maker(full)
    if len(chosen) == 1:
        return maker.make(*(one.choice for one in chosen.values()))
    points = maker.described(chosen["direct"].choice.points)
    return with_points(maker.make(chosen["images"].choice), full, points)
