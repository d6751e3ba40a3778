"""The variants of a map that a benchmark compares."""

from collections.abc import Callable
from dataclasses import dataclass

from slimsfm.domination import Solution
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import ProgressBar
from slimsfm.reduction import FrontierOptions, Maker, Weigh, frontier, keep_random_images, recommend

_RANDOM_SEEDS = range(5)


@dataclass(frozen=True, kw_only=True, eq=False)
class Making:
    """What variants of a map are made by."""

    map: Map
    """The map."""

    solution: Solution
    """Its dominating set."""

    weigh: Weigh
    """Tells the size of a map."""

    progress: ProgressBar
    """Told of long work."""


def _full(making: Making) -> list[Map]:
    return [making.map]


def _dominating(making: Making) -> list[Map]:
    names = list(making.map.images)
    return [keep_images(making.map, (names[i] for i in making.solution.chosen))]


def _random(making: Making) -> list[Map]:
    count = len(making.solution.chosen)
    return [keep_random_images(making.map, count, seed=seed) for seed in _RANDOM_SEEDS]


def _default(making: Making) -> list[Map]:
    options = FrontierOptions(uses=("direct",))
    found = frontier(making.map, None, making.weigh, options, making.progress)
    return [Maker(making.map).make(recommend(found, "direct").choice)]


VARIANTS: dict[str, Callable[[Making], list[Map]]] = {
    "full": _full,
    "dominating": _dominating,
    "default": _default,
    "random": _random,
}
"""What a variant's name stands for: maps to localize against, several where chance plays a part. `default` is
what `slimsfm reduce` gives; it is for direct matching alone."""
