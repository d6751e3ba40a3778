"""Keep a map right and up to date: check its poses, align it to units and places, add, merge, forget."""

from slimsfm.upkeep.checking import check
from slimsfm.upkeep.findings import (
    Blurred,
    ContradictedPair,
    Duplicate,
    MapCheck,
    Thread,
    Unlocalized,
    WrongPose,
)
from slimsfm.upkeep.repair import Repaired, repair

__all__ = [
    "Blurred",
    "ContradictedPair",
    "Duplicate",
    "MapCheck",
    "Repaired",
    "Thread",
    "Unlocalized",
    "WrongPose",
    "check",
    "repair",
]
