"""Predict what a larger map localizes that the map before did not, and the other way round."""

from collections.abc import Collection
from dataclasses import dataclass

from slimsfm.arrays import evenly_spaced
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent
from slimsfm.reduction.forecast import Trials
from slimsfm.selection.usable_points import LeftOut

_TESTS, _REFERENCES = 16, 12  # images left out, and references that each is matched with


@dataclass(frozen=True, kw_only=True)
class Growth:
    """How images of a larger map, each left out in turn, are localized by its old images and by all."""

    tests: tuple[str, ...]
    """Names of the images that were left out."""

    before: float
    """Percentage of them that the old images localize, from 0 to 100."""

    after: float
    """Percentage of them that all images localize."""

    lost: tuple[str, ...]
    """Those that the old images localize and all images do not."""


def predict_growth(map: Map, old: Collection[str], progress: ProgressBar = silent) -> Growth:
    """Predict what images that were added to a map gain.

    Up to 16 images, evenly spaced by name, are left out in turn, with the handicap of `Trials`, and localized
    from at most 12 references that see the most common points.

    Args:
        map: The larger map.
        old: Names of the images that were in it before.
        progress: Progress callback.
    """
    trials = Trials(map, LeftOut(map), conditions="clean")
    tests = [trials.tests[place] for place in evenly_spaced(len(trials.tests), _TESTS)]
    bar = progress(tests, "forecast what was gained")
    least = ADD_FRACTIONS[0]
    before, after, lost = 0, 0, []
    for test in bar:
        by_old = bool(trials.among([test], old, most=_REFERENCES).within(least))
        by_all = bool(trials.among([test], map.images, most=_REFERENCES).within(least))
        before, after = before + by_old, after + by_all
        if by_old and not by_all:
            lost.append(test)
    count = max(len(tests), 1)
    return Growth(
        tests=tuple(tests), before=100 * before / count, after=100 * after / count, lost=tuple(lost)
    )
