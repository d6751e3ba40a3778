"""The variants of a map that a benchmark compares.

A variant is spelled as a name, or as a name and settings: `random:8`, `points:500`, `dominating:k=2,rim`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slimsfm.domination import Solution
from slimsfm.features.methods import DETECTOR_FREE
from slimsfm.graph import ReferenceGraph
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import ProgressBar, silent
from slimsfm.reduction import (
    Choice,
    DominatingSetOptions,
    FrontierOptions,
    apply_choice,
    dominating_set,
    frontier,
    keep_random_images,
    recommend,
)
from slimsfm.selection import SELECTORS, current_selector
from slimsfm.selection.leave_one_out import LeftOut
from slimsfm.selection.usable_points import selection_problem

_DRAWS = 5
_SELECTOR = "information"


@dataclass(frozen=True, kw_only=True, eq=False)
class Making:
    """What variants of a map are made by."""

    map: Map
    """The map."""

    graph: ReferenceGraph
    """Its reference graph."""

    reduction: DominatingSetOptions
    """How its dominating set is chosen where a variant does not say otherwise."""

    solution: Solution
    """That dominating set."""

    progress: ProgressBar = silent
    """Told of long work."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of variant."""

    read: Callable[[list[str]], Any]
    """Makes settings of the words behind the colon, with an error where they cannot be."""

    make: Callable[[Making, Any], list[Map]]
    """Makes its maps of settings: several where chance plays a part, none where the map does not allow it."""

    takes: str
    """What it can be told."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A variant of a map."""

    name: str
    """As it was spelled."""

    kind: str
    """One of `VARIANTS`."""

    settings: Any
    """As the kind reads them."""

    @property
    def is_random(self) -> bool:
        """Whether chance plays a part."""
        return self.kind == "random"

    def make(self, making: Making) -> list[Map]:
        """Its maps."""
        return VARIANTS[self.kind].make(making, self.settings)


def parse_variant(text: str) -> Variant:
    """Read a variant.

    Raises:
        ValueError: There is no such variant, or it takes no such setting.
    """
    kind, colon, rest = text.partition(":")
    if kind not in VARIANTS:
        raise ValueError(f"variants must be among {', '.join(VARIANTS)}, got {text!r}")
    try:
        settings = VARIANTS[kind].read(rest.split(",") if colon else [])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"variants: {kind} takes {VARIANTS[kind].takes}, got {text!r} ({error})") from error
    return Variant(name=text, kind=kind, settings=settings)


def _nothing(words: list[str]) -> None:
    if words:
        raise ValueError(f"{words[0]!r} is unknown")


def _full(making: Making, _: None) -> list[Map]:
    return [making.map]


def _reduction_settings(words: list[str]) -> dict[str, Any]:
    """Fields of `DominatingSetOptions` that differ."""
    settings = {}
    for word in words:
        key, _, value = word.partition("=")
        field, read = _REDUCTION_WORDS[key]
        if field in settings:
            raise ValueError(f"{key} is given twice")
        settings[field] = read(value)
    DominatingSetOptions(**settings)  # refuses what cannot be
    return settings


def _flag(value: str) -> bool:
    if value:
        raise ValueError(f"takes no value, got {value!r}")
    return True


_REDUCTION_WORDS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "k": ("dominators", int),
    "budget": ("max_images", int),
    "threshold": ("threshold", float),
    "solver": ("solver", str),
    "cost": ("cost", str),
    "rim": ("rim", _flag),
}


def _dominating(making: Making, settings: dict[str, Any]) -> list[Map]:
    options = replace(making.reduction, **settings)
    chosen = dominating_set(making.graph, options, making.map).chosen if settings else making.solution.chosen
    return [keep_images(making.map, (making.graph.names[i] for i in chosen))]


def _count(words: list[str]) -> int | None:
    """The one setting, a positive number; None where there is none."""
    if not words:
        return None
    (word,) = words
    if int(word) < 1:
        raise ValueError(f"{word} is not positive")
    return int(word)


def _random(making: Making, count: int | None) -> list[Map]:
    count = count or len(making.solution.chosen)
    if count > len(making.map.images):
        return []
    return [keep_random_images(making.map, count, seed=seed) for seed in range(_DRAWS)]


def _default(making: Making, _: None) -> list[Map]:
    if making.map.info.extractor in DETECTOR_FREE:
        return []
    options = FrontierOptions(uses=("direct",))
    found = frontier(making.map, options, progress=making.progress)
    return [apply_choice(making.map, recommend(found, "direct").choice)]


def _points_settings(words: list[str]) -> tuple[int, str]:
    count, *rest = words
    (selector,) = rest or [_SELECTOR]
    return _count([count]) or 0, current_selector(selector)


def _points(making: Making, settings: tuple[int, str]) -> list[Map]:
    if making.map.info.extractor in DETECTOR_FREE:
        return []
    count, selector = settings
    problem = selection_problem(making.map, LeftOut(making.map), making.progress)
    points = np.sort(SELECTORS[selector](problem, count, seed=making.reduction.seed))
    choice = Choice(use="direct", method=selector, detail=f"{count} points", images=(), points=points)
    return [apply_choice(making.map, choice)]


VARIANTS = {
    "full": Kind(read=_nothing, make=_full, takes="no settings"),
    "dominating": Kind(
        read=_reduction_settings,
        make=_dominating,
        takes="k=2, rim, budget=8, threshold=0.05, solver=random and cost=observations",
    ),
    "default": Kind(read=_nothing, make=_default, takes="no settings"),
    "random": Kind(read=_count, make=_random, takes="a number of images"),
    "points": Kind(read=_points_settings, make=_points, takes="a number of points and a selector"),
}
"""What the names of variants stand for. `full` is all of the map, `dominating` a dominating set of its
images, `random` as many images drawn five times, or the number given, `default` what `slimsfm reduce` gives
by itself, and `points` so many points; the last two are for direct matching alone."""
