"""What strategies share that look at parts of a query: where to look, and what several looks found."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from slimsfm.arrays import Ids, Points2D
from slimsfm.localization.crop import Region, Sighting, best_region
from slimsfm.localization.strategy import PointMatches

_REFERENCES = 15  # images that are asked where the object is, as by the authors of OnePose
_SURE = 60  # matches that agree on it: no further image is asked


class Look(NamedTuple):
    """Points that were found in a query; none occurs twice."""

    points: Ids
    """Rows of the map's points."""

    points2D: Points2D
    """For each of them its pixels."""

    def added_to(self, before: "Look") -> "Look":
        """What is found now, and what was found before of points that are not found again."""
        rest = ~np.isin(before.points, self.points)
        parts = zip(self, (column[rest] for column in before), strict=True)
        return Look(*(np.concatenate(part) for part in parts))

    def matches(self, references: int = 0) -> PointMatches:
        """The same as matches, each with a keypoint of its own."""
        rows = np.arange(len(self.points), dtype=np.int64)
        return PointMatches(keypoints=rows, points=self.points, references=references, points2D=self.points2D)


class Finding(NamedTuple):
    """Where reference images say that the object is."""

    region: Region | None
    """The part of the query that shows it, if any of them tells."""

    references: int
    """Images that were asked."""


def spread(count: int) -> list[int]:
    """Some of so many images in order, few enough to ask each of them, as far apart as can be."""
    return np.linspace(0, count - 1, min(_REFERENCES, count)).round().astype(int).tolist()


def find(sightings: Iterable[Sighting | None]) -> Finding:
    """Where most matches agree; when enough do, no further sighting is asked for."""
    seen: list[Sighting | None] = []
    for sighting in sightings:
        seen.append(sighting)
        if sighting is not None and sighting.inliers >= _SURE:
            break
    return Finding(best_region(seen), len(seen))
