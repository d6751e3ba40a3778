"""What dominating sets come to over all objects: the figures in the paper's text."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from slimsfm.evaluation.results import ObjectResult


@dataclass(frozen=True, kw_only=True)
class DominationSummary:
    """Sizes of the dominating sets that one method gave."""

    method: str
    """The method."""

    objects: int
    """How many objects there are."""

    smallest: int
    """Images of the smallest set."""

    mean: float
    """Images of a set on average."""

    largest: int
    """Images of the largest set."""

    images_kept_mean: float
    """Share of the reference images that is kept, on average."""

    images_kept_median: float
    """The median of that."""

    points_kept_mean: float
    """Share of the points that is kept, on average."""

    points_kept_median: float
    """The median of that."""

    def to_json(self) -> dict:
        """As plain values."""
        return asdict(self)


def summarize_domination(results: Sequence[ObjectResult]) -> list[DominationSummary]:
    """One summary a method."""
    methods = dict.fromkeys(one.method for result in results for one in result.maps)
    return [_summary(method, results) for method in methods]


def _summary(method: str, results: Sequence[ObjectResult]) -> DominationSummary:
    maps = [one for result in results for one in result.maps if one.method == method]
    sizes = np.array([len(one.dominating_set) for one in maps])
    images = sizes / [one.references for one in maps]
    points = np.array([one.dominating_points / one.points for one in maps])
    return DominationSummary(
        method=method,
        objects=len(maps),
        smallest=int(sizes.min()),
        mean=float(sizes.mean()),
        largest=int(sizes.max()),
        images_kept_mean=float(images.mean()),
        images_kept_median=float(np.median(images)),
        points_kept_mean=float(points.mean()),
        points_kept_median=float(np.median(points)),
    )
