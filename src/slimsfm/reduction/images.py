"""From a map to a slim one: keep a dominating set of the reference images and the points they see."""

from dataclasses import dataclass

import numpy as np

from slimsfm.domination import SOLVERS, DominationProblem, Solution
from slimsfm.errors import InputError
from slimsfm.graph import ReferenceGraph
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images


@dataclass(frozen=True, kw_only=True)
class ReductionOptions:
    """Which reference images to keep."""

    threshold: float = 0.05
    """Largest relative corner error of a pose for which an image counts as localized."""

    solver: str = "exact"
    """Who chooses the dominating set: "exact" (minimum, proven) or "random" (the paper's)."""

    seed: int = 0
    """Seed of every random choice."""

    def __post_init__(self) -> None:
        if not self.threshold > 0:
            raise ValueError(f"threshold must be positive, got {self.threshold}")
        if self.solver not in SOLVERS:
            raise ValueError(f"solver must be one of {', '.join(sorted(SOLVERS))}, got {self.solver!r}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Reduction:
    """A slim map and how its images were chosen."""

    map: Map
    """The slim map."""

    solution: Solution
    """The dominating set, with what is known of its optimality."""


def reduce_map(map: Map, graph: ReferenceGraph, options: ReductionOptions = ReductionOptions()) -> Reduction:
    """Keep a dominating set of the reference images and the points they see: the paper's X' and P' [1].

    Args:
        map: The map.
        graph: Its reference graph.
        options: How to choose.

    Raises:
        ValueError: The graph is of another map.

    References:
        [1] Joseph, Amrutur and Bhatnagar, Accelerating SfM-based Pose Estimation with Dominating Set, 2025.
    """
    if graph.names != tuple(map.images):
        raise ValueError("graph must be of this map, but its images are others")
    solution = dominating_set(graph, options)
    return Reduction(map=keep_images(map, (graph.names[i] for i in solution.chosen)), solution=solution)


def dominating_set(graph: ReferenceGraph, options: ReductionOptions) -> Solution:
    """Choose the images that localize all others, by index into the graph's names."""
    problem = DominationProblem(graph.adjacency(options.threshold))
    return SOLVERS[options.solver](problem, seed=options.seed)


def keep_random_images(map: Map, count: int, *, seed: int) -> Map:
    """Keep this many images drawn at random, and the points they see: the paper's baseline.

    Raises:
        InputError: The map has fewer images, or not one is wanted.
    """
    names = list(map.images)
    if not 1 <= count <= len(names):
        raise InputError(f"{count} random images cannot be drawn from the {len(names)} of the map")
    chosen = np.random.default_rng(seed).choice(len(names), size=count, replace=False)
    return keep_images(map, (names[i] for i in chosen))
