"""Sets of reference images to keep: dominating sets, orders of all images, and random images.

A dominating set and the points it sees are the X' and P' of the paper [1].

References:
    [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set, 2025.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.sparse import csr_array

from slimsfm.domination import SOLVERS, DominationProblem, Solution, cover_order
from slimsfm.domination.local_search import least_error_by_swaps
from slimsfm.errors import InputError
from slimsfm.graph import ReferenceGraph
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.reduction.rim import rim_groups

Cost = Literal["image", "observations"]

_PAPER = "random"  # the solver whose sets are not improved by swaps


@dataclass(frozen=True, kw_only=True)
class DominatingSetOptions:
    """How a dominating set of the reference images is chosen."""

    threshold: float = 0.05
    """Largest relative corner error of a pose for which an image counts as localized."""

    solver: str = "exact"
    """Solver: "exact" (proven minimum), "cpsat" (the same for thousands of images, with OR-Tools), "greedy"
    (fast) or "random" (the paper's)."""

    seed: int = 0
    """Seed of all random choices."""

    dominators: int = 1
    """Number of kept images that localize each image that is not kept, or all that can if they are fewer."""

    rim: bool = False
    """Localize the images at the rim of the capture from images nearly as far out, and keep an image of each
    part of the object's surface: queries at the rim have reference images on one side only."""

    cost: Cost = "image"
    """What to minimize: the number of kept images, or of their observations, which determines memory and the
    time of exhaustive matching."""

    max_images: int | None = None
    """Largest number of images. If it is too small to localize all others, as many as possible are."""

    best: bool = False
    """Find the set with the proven least sum of errors among the smallest sets, which may take a minute for
    50 images. Otherwise swaps reduce the sum quickly. The sets of the paper's solver are not improved."""

    def __post_init__(self) -> None:
        if not self.threshold > 0:
            raise ValueError(f"threshold must be positive, got {self.threshold}")
        if self.solver not in SOLVERS:
            raise ValueError(f"solver must be one of {', '.join(sorted(SOLVERS))}, got {self.solver!r}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if self.dominators < 1:
            raise ValueError(f"dominators must be at least 1, got {self.dominators}")
        if self.cost not in get_args(Cost):
            raise ValueError(f"cost must be one of {', '.join(get_args(Cost))}, got {self.cost!r}")
        if self.max_images is not None and self.max_images < 1:
            raise ValueError(f"max_images must be at least 1, got {self.max_images}")
        if self.max_images is not None and self.cost != "image":
            raise ValueError(f"max_images limits a number of images: cost must be image, got {self.cost!r}")


def dominating_set(graph: ReferenceGraph, options: DominatingSetOptions, map: Map | None = None) -> Solution:
    """Choose images that localize all others, as indices into the graph's names.

    Args:
        graph: The reference graph.
        options: How to choose. A limit on the images that is large enough has no effect.
        map: The map of the graph; only `rim` and costs other than "image" need it.

    Returns:
        The images. Optimality refers to their number or cost; to their errors only with `best`.

    Raises:
        ValueError: The options need the map, or the graph belongs to another map.
    """
    problem = _problem(graph, options, map)
    found = SOLVERS[options.solver](problem, seed=options.seed)
    if options.max_images is not None and len(found.chosen) > options.max_images:
        problem = _problem(graph, options, map, budget=options.max_images)
        found = SOLVERS[options.solver](problem, seed=options.seed)
    if options.best or options.solver == _PAPER:
        return found
    chosen = least_error_by_swaps(_with_errors(problem, graph), found.chosen)
    return replace(found, chosen=chosen, cost=problem.cost(chosen), unmet=problem.num_unmet(chosen))


def image_order(
    graph: ReferenceGraph, options: DominatingSetOptions, map: Map | None = None
) -> tuple[str, ...]:
    """Order all images such that each prefix localizes nearly as many others as any set of its size.

    The dominating set comes first, then images that localize others a second time, a third time and so on.

    Args:
        graph: The reference graph.
        options: How the dominating set is chosen, and what an image costs.
        map: The map of the graph; only `rim` and costs other than "image" need it.

    Raises:
        ValueError: The options need the map, or the graph belongs to another map.
    """
    first = dominating_set(graph, options, map).chosen
    order = cover_order(_problem(graph, options, map), first=first)
    return tuple(graph.names[i] for i in order)


def images_within(order: tuple[str, ...], fits: Callable[[tuple[str, ...]], bool]) -> tuple[str, ...]:
    """The longest prefix of an order of images that is within a limit, such as bytes or points.

    Args:
        order: Names, the most important first.
        fits: Whether images are within the limit. If a prefix is not, no longer one may be.

    Returns:
        The first names, in order; empty if the first one alone exceeds the limit.

    Notes:
        Bisection: `fits` is called about log2(len(order)) times.
    """
    fitting, too_many = 0, len(order) + 1
    while too_many - fitting > 1:
        middle = (fitting + too_many) // 2
        if fits(order[:middle]):
            fitting = middle
        else:
            too_many = middle
    return order[:fitting]


def _problem(
    graph: ReferenceGraph, options: DominatingSetOptions, map: Map | None, budget: int | None = None
) -> DominationProblem:
    if map is not None and graph.names != tuple(map.images):
        raise ValueError("graph must have the images of this map, but it has others")
    adjacency = graph.adjacency(options.threshold)
    return DominationProblem(
        adjacency,
        costs=_costs(options, map),
        dominators=options.dominators,
        budget=budget,
        groups=_groups(adjacency, options, map),
        errors=graph.errors if options.best and options.solver != _PAPER else None,
    )


def _with_errors(problem: DominationProblem, graph: ReferenceGraph) -> DominationProblem:
    return DominationProblem(
        problem.adjacency,
        costs=problem.costs,
        dominators=problem.dominators,
        budget=problem.budget,
        groups=problem.groups,
        errors=graph.errors,
    )


def _costs(options: DominatingSetOptions, map: Map | None) -> np.ndarray | None:
    if options.cost == "image":
        return None
    if map is None:
        raise ValueError(f"map must be given where cost is {options.cost!r}")
    return np.array([max(len(seen.rows), 1) for seen in map.observations.values()], np.float64)


def _groups(adjacency: csr_array, options: DominatingSetOptions, map: Map | None) -> csr_array | None:
    if not options.rim:
        return None
    if map is None:
        raise ValueError("map must be given where rim is set")
    return rim_groups(map, adjacency)


def keep_random_images(map: Map, count: int, *, seed: int) -> Map:
    """Keep this many images drawn at random, and the points they see: the baseline of the paper.

    Raises:
        InputError: The map has fewer images, or `count` is not positive.
    """
    names = list(map.images)
    if not 1 <= count <= len(names):
        raise InputError(f"{count} random images cannot be drawn from the {len(names)} of the map")
    chosen = np.random.default_rng(seed).choice(len(names), size=count, replace=False)
    return keep_images(map, (names[i] for i in chosen))
