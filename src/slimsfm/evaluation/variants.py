"""The variants of a map that a benchmark compares.

A variant is a name, or a name and settings: `random:8`, `points:500`, `dominating:k=2,rim`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slimsfm.domination import Solution
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
from slimsfm.selection.usable_points import LeftOut, selection_problem

_DRAWS = 5
_SELECTOR = "information"


@dataclass(frozen=True, kw_only=True, eq=False)
class VariantInputs:
    """What variants are made from."""

    map: Map
    """The full map."""

    graph: ReferenceGraph
    """Its reference graph."""

    reduction: DominatingSetOptions
    """How to choose dominating sets; the settings of a variant override it."""

    solution: Solution
    """The dominating set for these options."""

    progress: ProgressBar = silent
    """Progress callback."""


@dataclass(frozen=True, kw_only=True)
class VariantKind:
    """A kind of variant: how to read its settings and how to make its maps."""

    read: Callable[[list[str]], Any]
    """Parses the words after the colon; raises an error for invalid ones."""

    make: Callable[[VariantInputs, Any], list[Map]]
    """Makes the maps: several for random variants, none if the variant is not possible."""

    takes: str
    """Describes the settings."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A variant of a map."""

    name: str
    """The variant as spelled in the options."""

    kind: str
    """Key of `VARIANTS`."""

    settings: Any
    """Settings as the kind parses them."""

    @property
    def is_random(self) -> bool:
        """Whether its maps are drawn at random."""
        return self.kind == "random"

    def make(self, inputs: VariantInputs) -> list[Map]:
        """Make the maps of this variant."""
        return VARIANTS[self.kind].make(inputs, self.settings)


def parse_variant(text: str) -> Variant:
    """Read a variant.

    Raises:
        ValueError: The variant or a setting of it is unknown.
    """
    kind, colon, rest = text.partition(":")
    if kind not in VARIANTS:
        raise ValueError(f"variants must be among {', '.join(VARIANTS)}, got {text!r}")
    try:
        settings = VARIANTS[kind].read(rest.split(",") if colon else [])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"variants: {kind} takes {VARIANTS[kind].takes}, got {text!r} ({error})") from error
    return Variant(name=text, kind=kind, settings=settings)


def _no_settings(words: list[str]) -> None:
    if words:
        raise ValueError(f"{words[0]!r} is unknown")


def _full(inputs: VariantInputs, _: None) -> list[Map]:
    return [inputs.map]


def _reduction_settings(words: list[str]) -> dict[str, Any]:
    """The fields of `DominatingSetOptions` to override."""
    settings = {}
    for word in words:
        key, _, value = word.partition("=")
        field, read = _REDUCTION_WORDS[key]
        if field in settings:
            raise ValueError(f"{key} is set twice")
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


def _dominating(inputs: VariantInputs, settings: dict[str, Any]) -> list[Map]:
    options = replace(inputs.reduction, **settings)
    chosen = dominating_set(inputs.graph, options, inputs.map).chosen if settings else inputs.solution.chosen
    return [keep_images(inputs.map, (inputs.graph.names[i] for i in chosen))]


def _count(words: list[str]) -> int | None:
    """The only setting, a positive number; None without settings."""
    if not words:
        return None
    (word,) = words
    if int(word) < 1:
        raise ValueError(f"{word} is not positive")
    return int(word)


def _random(inputs: VariantInputs, count: int | None) -> list[Map]:
    count = count or len(inputs.solution.chosen)
    if count > len(inputs.map.images):
        return []
    return [keep_random_images(inputs.map, count, seed=seed) for seed in range(_DRAWS)]


def _default(inputs: VariantInputs, _: None) -> list[Map]:
    if not inputs.map.has_keypoints:
        return []
    options = FrontierOptions(uses=("direct",))
    found = frontier(inputs.map, options, progress=inputs.progress)
    return [apply_choice(inputs.map, recommend(found, "direct").choice)]


def _points_settings(words: list[str]) -> tuple[int, str]:
    count, *rest = words
    (selector,) = rest or [_SELECTOR]
    return _count([count]) or 0, current_selector(selector)


def _points(inputs: VariantInputs, settings: tuple[int, str]) -> list[Map]:
    if not inputs.map.has_keypoints:
        return []
    count, selector = settings
    problem = selection_problem(inputs.map, LeftOut(inputs.map), inputs.progress)
    points = np.sort(SELECTORS[selector](problem, count, seed=inputs.reduction.seed))
    choice = Choice(use="direct", method=selector, detail=f"{count} points", images=(), points=points)
    return [apply_choice(inputs.map, choice)]


VARIANTS = {
    "full": VariantKind(read=_no_settings, make=_full, takes="no settings"),
    "dominating": VariantKind(
        read=_reduction_settings,
        make=_dominating,
        takes="k=2, rim, budget=8, threshold=0.05, solver=random and cost=observations",
    ),
    "default": VariantKind(read=_no_settings, make=_default, takes="no settings"),
    "random": VariantKind(read=_count, make=_random, takes="a number of images"),
    "points": VariantKind(read=_points_settings, make=_points, takes="a number of points and a selector"),
}
"""`full` is the full map, `dominating` a dominating set of its images, `random` as many random images, drawn
five times, or the given number, `default` the default result of `slimsfm reduce`, and `points` the given
number of points. `default` and `points` support only direct matching."""
