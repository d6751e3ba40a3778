"""Ways to choose the images of a slim map, as options of a command."""

from dataclasses import dataclass, replace
from pathlib import Path

from slimsfm.cli.execution import Execution, resumable
from slimsfm.cli.output import console
from slimsfm.domination import Solution
from slimsfm.errors import InputError
from slimsfm.graph import GraphOptions, ReferenceGraph
from slimsfm.graph.io import load_or_compute_graph, read_given_graph
from slimsfm.graph.source import Edges
from slimsfm.mapping.io import weigh_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import shown
from slimsfm.reduction import (
    ReductionOptions,
    Wish,
    dominating_set,
    image_order,
    images_within,
    keep_random_images,
)
from slimsfm.reduction.images import Cost


@dataclass(frozen=True, kw_only=True)
class ByImages:
    """Keep certain images, or a dominating set of them; given one of these, nothing is compared."""

    images: tuple[str, ...] = ()
    """Keep just these images."""

    random: int | None = None
    """Keep this many images drawn at random (the paper's baseline)."""

    solver: str | None = None
    """Who chooses: exact, cpsat, greedy or random (the paper's)."""

    dominators: int | None = None
    """How many kept images localize each one that is not kept."""

    rim: bool = False
    """Keep the rim of the capture."""

    cost: Cost | None = None
    """What is to be least: the number of images, or that of their observations."""

    threshold: float | None = None
    """Largest relative corner error of a pose for which an image counts as localized."""

    edges: Edges | None = None
    """How the reference graph is computed; `slimsfm graph --help` explains each way."""

    graph: Path | None = None
    """Errors of another system instead: .csv (reference, query, error) or .npz as of `slimsfm graph`."""

    paper: bool = False
    """Exactly the paper's procedure: all pairs localized anew, smallest of 1000 random sets."""

    def __post_init__(self) -> None:
        _ = self.options(0)  # refuses what cannot be
        for name, default in (("images", ()), ("random", None), ("paper", False)):
            if getattr(self, name) != default and replace(self, **{name: default}).is_wanted:
                raise ValueError(f"{name} excludes all other ways to choose images")

    @property
    def is_wanted(self) -> bool:
        """Whether anything was given."""
        return self != ByImages()

    @property
    def is_given(self) -> bool:
        """Whether nothing is left to choose but by chance."""
        return bool(self.images) or self.random is not None

    def options(self, seed: int) -> ReductionOptions:
        """The options of the choice."""
        given = {name: getattr(self, name) for name in ("solver", "dominators", "cost", "threshold")}
        given = {name: value for name, value in given.items() if value is not None}
        if self.paper:
            given["solver"] = "random"
        return ReductionOptions(rim=self.rim, seed=seed, **given)

    def load_or_compute_graph(self, full: Map, path: Path, execution: Execution) -> ReferenceGraph:
        """The reference graph to choose by."""
        if self.graph:
            return read_given_graph(self.graph, full)
        edges = GraphOptions(edges=self.edges or "auto", threshold=self.options(0).threshold)
        if self.paper:
            edges = GraphOptions(edges="localize", candidates="all")
        with resumable():
            return load_or_compute_graph(full, path, edges, execution.open_executor(), shown).graph

    def choose(self, full: Map, path: Path, wish: Wish, seed: int, execution: Execution) -> tuple[str, ...]:
        """The names of the images to keep.

        Raises:
            InputError: They cannot be chosen within the limits.
        """
        if self.images:
            return self.images
        if self.random is not None:
            return tuple(keep_random_images(full, self.random, seed=seed).images)
        if wish.max_loss is not None or wish.max_ms is not None:
            raise InputError(
                "max-loss and max-ms choose among many ways to reduce; leave out how images are chosen"
            )
        try:
            options = replace(self.options(seed), max_images=wish.max_images)
        except ValueError as error:
            raise InputError(str(error)) from error
        return _dominating(full, self.load_or_compute_graph(full, path, execution), options, wish)


def _dominating(full: Map, graph: ReferenceGraph, options: ReductionOptions, wish: Wish) -> tuple[str, ...]:
    solution = dominating_set(graph, options, full)
    _print_solution(graph, solution, options)
    names = tuple(graph.names[i] for i in solution.chosen)

    def fits(some: tuple[str, ...]) -> bool:
        slim = keep_images(full, some)
        few = wish.max_points is None or len(slim.point3D_ids) <= wish.max_points
        return few and (wish.max_bytes is None or weigh_map(slim) <= wish.max_bytes)

    if not fits(names):
        names = images_within(image_order(graph, options, full), fits)
    if not names:
        raise InputError("not even one image keeps to max-points or max-bytes; ask for more")
    return names


def _print_solution(graph: ReferenceGraph, solution: Solution, options: ReductionOptions) -> None:
    proof = "proven smallest" if solution.is_cheapest else f"at least {solution.lower_bound} are needed"
    alone = f"; {solution.unmet} images are localized by too few" if solution.unmet else ""
    console.print(
        f"reference graph: {graph.num_edges(options.threshold)} edges among {len(graph.names)} images; "
        f"dominating set: {len(solution.chosen)} images ({proof}){alone}"
    )
