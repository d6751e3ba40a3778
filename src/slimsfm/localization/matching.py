"""How a query is matched with one reference image: nearest descriptors, a network, or without keypoints."""

from importlib import import_module
from typing import Protocol, runtime_checkable

from slimsfm.arrays import Descriptors
from slimsfm.features import Features, Matcher, load_matcher, match_nearest, nearest_for, unit_rows
from slimsfm.features.methods import DETECTOR_FREE
from slimsfm.features.nearest import NearestOptions
from slimsfm.localization.strategy import MatchingOptions, PointMatches, Query, Target
from slimsfm.mapping.map import Map


@runtime_checkable
class ReferenceMatching(Protocol):
    """Matches queries with the reference images of one map, numbered in order of name."""

    def match(self, query: Query, row: int, strongest: int | None) -> PointMatches:
        """Match a query with an image; so many of its keypoints take part, where they are matched singly."""
        ...

    def target(self, row: int) -> Target:
        """What the image sees."""
        ...


def nearest_options(map: Map, options: MatchingOptions) -> NearestOptions:
    """Which nearest neighbours match: as the options say, or as suits the map's descriptors."""
    return options.nearest or nearest_for(map.info.extractor)


def matching_with(map: Map, options: MatchingOptions) -> ReferenceMatching:
    """The way of matching that the options ask for.

    Raises:
        InputError: There is no such matcher, or it cannot match features of the map's kind.
    """
    extractor = map.info.extractor
    name = options.matcher
    if name == "auto":
        name = extractor if extractor in DETECTOR_FREE else "nearest"
    if name == "nearest":
        return NearestMatching(map, nearest_options(map, options))
    if name in DETECTOR_FREE:
        return import_module("slimsfm.localization.detector_free").DetectorFreeMatching(map)
    return PairMatching(map, load_matcher(name, extractor))


class NearestMatching:
    """Matches descriptors by their distance, just with keypoints that see a point of the map.

    A match to any other keypoint gives the pose nothing.
    """

    def __init__(self, map: Map, options: NearestOptions) -> None:
        self._options = options
        self._targets = [reference_target(map, name) for name in map.observations]

    def match(self, query: Query, row: int, strongest: int | None) -> PointMatches:
        """Match a query's descriptors with those of an image."""
        return match_target(query.descriptors[:strongest], self._targets[row], self._options, references=1)

    def target(self, row: int) -> Target:
        """What the image sees."""
        return self._targets[row]


class PairMatching:
    """Matches features by a network that looks at those of both images; just those that see a point."""

    def __init__(self, map: Map, matcher: Matcher) -> None:
        self._matcher = matcher
        self._points = [seen.points for seen in map.observations.values()]
        self._seeing = [_seeing(map, name) for name in map.observations]

    def match(self, query: Query, row: int, strongest: int | None) -> PointMatches:  # noqa: ARG002
        """Match all of a query's features with those of an image."""
        pairs = self._matcher.match(query.features, self._seeing[row])
        return PointMatches(keypoints=pairs[:, 0], points=self._points[row][pairs[:, 1]], references=1)

    def target(self, row: int) -> Target:
        """What the image sees."""
        return unit_rows(self._seeing[row].descriptors), self._points[row]


def _seeing(map: Map, name: str) -> Features:
    return map.features[name][map.observations[name].rows]


def reference_target(map: Map, name: str) -> Target:
    """What there is to match of a reference image."""
    return unit_rows(_seeing(map, name).descriptors), map.observations[name].points


def match_target(
    descriptors: Descriptors, target: Target, options: NearestOptions, references: int = 0
) -> PointMatches:
    """Match descriptors of a query with those of points."""
    target_descriptors, points = target
    pairs = match_nearest(descriptors, target_descriptors, options)
    return PointMatches(keypoints=pairs[:, 0], points=points[pairs[:, 1]], references=references)
