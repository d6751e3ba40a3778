"""`slimsfm reduce`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from slimsfm.cli.choices import print_change, promise
from slimsfm.cli.execution import Execution
from slimsfm.cli.output import Flat, MapPath, OutputPath, Stopwatch, check_output, console, finish, parse
from slimsfm.cli.reduction_options import ByImages, Limits
from slimsfm.cli.results import weighing
from slimsfm.domination import Solution
from slimsfm.errors import InputError
from slimsfm.graph import ReferenceGraph
from slimsfm.mapping.direct import with_points
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.map import Map, check_has_features
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import shown
from slimsfm.reduction import (
    Candidate,
    FrontierOptions,
    Maker,
    ReductionOptions,
    Weigh,
    Wish,
    dominating_set,
    frontier,
    image_order,
    images_within,
    keep_random_images,
    recommend,
    try_images,
)
from slimsfm.selection import SELECTORS

Use = Literal["direct", "images", "both"]
_USES = {"direct": ("direct",), "images": ("images",), "both": ("direct", "images")}


def reduce(
    map: MapPath,
    /,
    output: OutputPath,
    for_: Annotated[Use, tyro.conf.arg(name="for")] = "direct",
    limits: Annotated[Limits, Flat] = Limits(),
    selector: str | None = None,
    by: Annotated[ByImages, Flat] = ByImages(),
    images: tuple[str, ...] = (),
    random: int | None = None,
    seed: int = 0,
    execution: Annotated[Execution, Flat] = Execution(),
    overwrite: bool = False,
) -> None:
    """Make a map small, and say what that costs.

    Many ways are tried on the map's own images, each left out in turn, and the smallest that loses nothing is
    taken; `slimsfm frontier` lists them all.

    Args:
        map: A map.
        output: Where the slim map is written.
        for_: Match queries with points (direct), with images (images), or either way (both).
        limits: What the slim map must keep to.
        selector: Let this one choose the points: information, kcover, probabilistic or random.
        by: How images are chosen.
        images: Keep just these images.
        random: Keep this many images drawn at random (the paper's baseline).
        seed: Seed of every random choice.
        execution: Where the reference graph is computed.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    check_output(output, map, overwrite=overwrite)
    _check_one_way(by, images, random, selector)
    full = read_map(map)
    check_has_features(full)
    if len(full.images) < 2:
        raise InputError(f"{map}: has one image; there is nothing to reduce")
    by_names = bool(images) or random is not None or by.is_wanted
    uses = _USES[for_] if for_ != "direct" or not by_names else ("images",)
    wish = limits.wish
    with weighing() as weigh:
        chosen: dict[str, Candidate] = {}
        if by_names:
            names = images or _image_set(full, map, by, wish, random, seed, execution, weigh)
            chosen["images"] = try_images(full, names, weigh, shown)
        compared = tuple(use for use in uses if use not in chosen)
        if compared:
            options = _frontier_options(compared, selector, wish, seed)
            graph = by.graph_of(full, map, execution) if "images" in compared else None
            found = frontier(full, graph, weigh, options, shown)
            chosen |= {use: recommend(found, use, wish) for use in compared}
    slim = _slim(full, chosen)
    write_map(slim, output, overwrite=overwrite)
    print_change(map, full, output, slim)
    for one in chosen.values():
        console.print(f"{one.choice.method} ({one.choice.detail}): {promise(map, full, one)}")
    finish(f"{output}: written", watch, "localize", output, "IMAGES", "-o", "poses.json")


def _check_one_way(by: ByImages, images: tuple[str, ...], random: int | None, selector: str | None) -> None:
    given = {"images": bool(images), "random": random is not None, "options of image choice": by.is_wanted}
    ways = [f"--{name}" if " " not in name else name for name, wanted in given.items() if wanted]
    if len(ways) > 1:
        raise InputError(f"{' and '.join(ways)} exclude each other")
    if selector is not None and selector not in SELECTORS:
        raise InputError(f"selector must be one of {', '.join(SELECTORS)}, got {selector!r}")


def _frontier_options(uses: tuple[str, ...], selector: str | None, wish: Wish, seed: int) -> FrontierOptions:
    options = FrontierOptions(uses=uses, seed=seed)
    if selector:
        options = replace(options, selectors=(selector,))
    if wish.max_points:
        options = replace(options, budgets=(*options.budgets, wish.max_points))
    return options


def _image_set(
    full: Map,
    path: Path,
    by: ByImages,
    wish: Wish,
    random: int | None,
    seed: int,
    execution: Execution,
    weigh: Weigh,
) -> tuple[str, ...]:
    """The images that were asked for."""
    if random is not None:
        return tuple(keep_random_images(full, random, seed=seed).images)
    if wish.max_loss is not None or wish.max_ms is not None:
        raise InputError(
            "max-loss and max-ms choose among many ways to reduce; leave out how images are chosen"
        )
    graph = by.graph_of(full, path, execution)
    options = replace(by.options(seed), max_images=wish.max_images)
    solution = dominating_set(graph, options, full)
    _print_solution(graph, solution, options)
    names = tuple(graph.names[i] for i in solution.chosen)

    def fits(some: tuple[str, ...]) -> bool:
        slim = keep_images(full, some)
        few = wish.max_points is None or len(slim.point3D_ids) <= wish.max_points
        return few and (wish.max_bytes is None or weigh(slim) <= wish.max_bytes)

    if not fits(names):
        names = images_within(image_order(graph, options, full), fits)
    if not names:
        raise InputError("not even one image keeps to max-points or max-bytes; ask for more")
    return names


def _print_solution(graph: ReferenceGraph, solution: Solution, options: ReductionOptions) -> None:
    proof = "proven smallest" if solution.is_optimal else f"at least {solution.lower_bound} are needed"
    console.print(
        f"reference graph: {graph.num_edges(options.threshold)} edges among {len(graph.names)} images; "
        f"dominating set: {len(solution.chosen)} images ({proof})"
    )


def _slim(full: Map, chosen: dict[str, Candidate]) -> Map:
    maker = Maker(full)
    if len(chosen) == 1:
        return maker.make(*(one.choice for one in chosen.values()))
    points = maker.described(chosen["direct"].choice.points)
    return with_points(maker.make(chosen["images"].choice), full, points)


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    parse(reduce, arguments)
