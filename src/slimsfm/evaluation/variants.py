"""The variants of a map that a benchmark compares."""

from collections.abc import Callable

from slimsfm.domination import Solution
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.reduction import keep_random_images

_RANDOM_SEEDS = range(5)


def _full(map: Map, solution: Solution) -> list[Map]:  # noqa: ARG001
    return [map]


def _dominating(map: Map, solution: Solution) -> list[Map]:
    names = list(map.images)
    return [keep_images(map, (names[i] for i in solution.chosen))]


def _random(map: Map, solution: Solution) -> list[Map]:
    return [keep_random_images(map, len(solution.chosen), seed=seed) for seed in _RANDOM_SEEDS]


VARIANTS: dict[str, Callable[[Map, Solution], list[Map]]] = {
    "full": _full,
    "dominating": _dominating,
    "random": _random,
}
"""What a variant's name stands for: maps to localize against, several where chance plays a part."""
