"""How queries are localized, and which strategies there are."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

from slimsfm.features.registry import importing, load_object, plugins
from slimsfm.localization.cameras import FocalLength
from slimsfm.localization.rounds import ExtractionChoice
from slimsfm.localization.strategy import MatchingOptions, Strategy
from slimsfm.mapping.map import Map
from slimsfm.pose import RansacOptions

# Paths, not classes: naming a strategy must not import its dependencies.
STRATEGIES = {
    "direct": "slimsfm.localization.strategies:Direct",
    "exhaustive": "slimsfm.localization.strategies:Exhaustive",
    "onepose": "slimsfm.methods.onepose.strategy:OnePoseStrategy",
    "onepose++": "slimsfm.methods.onepose_plus.strategy:OnePosePlusStrategy",
    "progressive": "slimsfm.localization.strategies:Progressive",
    "retrieval": "slimsfm.localization.strategies:Retrieval",
}


@dataclass(frozen=True, kw_only=True)
class LocalizationOptions:
    """How queries are localized."""

    strategy: str = "auto"
    """What to match against: every reference image (exhaustive), the images most similar to the query
    (retrieval), one image after another until the pose is sure (progressive), or the points, by their
    descriptors (direct) or by a network (onepose, onepose++). auto: direct if the map has points chosen for
    it, exhaustive if it was built without a detector, else progressive."""

    matching: MatchingOptions = MatchingOptions()
    """How the strategy matches."""

    ransac: RansacOptions = RansacOptions()
    """How the pose is estimated."""

    focal: FocalLength = "auto"
    """How far the focal length of the queries is believed. auto: as its source says, and it is estimated
    together with the pose where it is not known or where the matches contradict it. known: as it is, without
    correction. approximate: to 30 %. unknown: not at all."""

    extraction: ExtractionChoice = "rounds"
    """Image that features of a query are extracted from: a small version of it first, and larger ones only
    until the pose is sure, which all points near it make exact (rounds), or the whole image, without that
    second pass, as in version 0.1 (whole)."""

    min_confidence: float = 0.5
    """Poses of lower confidence are discarded: the query counts as not localized."""

    def __post_init__(self) -> None:
        known = sorted({**STRATEGIES, **plugins("strategy")})
        if self.strategy not in ("auto", *known):
            raise ValueError(f"strategy must be auto or one of {', '.join(known)}, got {self.strategy!r}")
        if self.extraction not in get_args(ExtractionChoice):
            raise ValueError(
                f"extraction must be one of {', '.join(get_args(ExtractionChoice))}, got {self.extraction!r}"
            )
        if not 0 <= self.min_confidence <= 1:
            raise ValueError(f"min_confidence must be between 0 and 1, got {self.min_confidence}")

    def strategy_for(self, map: Map) -> str:
        """Name of the strategy to use with a map."""
        if self.strategy != "auto":
            return self.strategy
        if not map.has_keypoints:
            return "exhaustive"
        return "progressive" if map.point_descriptors is None else "direct"


def load_strategy(name: str, map: Map, options: MatchingOptions = MatchingOptions()) -> Strategy:
    """Create the strategy of this name for a map.

    Raises:
        InputError: A package or weights that the strategy needs are missing.
        MapError: The strategy cannot work with this kind of map.
    """
    with importing(f"strategy {name!r}"):
        return _strategy_class(name)(map, options)


def supports(strategy: str, map: Map) -> bool:
    """Whether a map has what the strategy of this name requires.

    Raises:
        InputError: A package that the strategy needs is missing.
    """
    if strategy == "auto":
        return True
    with importing(f"strategy {strategy!r}"):
        requires = getattr(_strategy_class(strategy), "requires", "features")
    return map.has_keypoints if requires == "points" else not map.is_for_direct_matching


def _strategy_class(name: str) -> Callable[[Map, MatchingOptions], Strategy]:
    return load_object({**plugins("strategy"), **STRATEGIES}[name])
