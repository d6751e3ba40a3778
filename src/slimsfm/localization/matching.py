"""How a query is matched with one reference image: nearest descriptors, a network, or without keypoints."""

from functools import lru_cache
from typing import Protocol, runtime_checkable

from slimsfm.arrays import Descriptors
from slimsfm.errors import InputError
from slimsfm.features import (
    Features,
    Matcher,
    NearestOptions,
    load_extractor,
    load_matcher,
    match_nearest,
    unit_rows,
)
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

    def describe(self, query: Query) -> Descriptors:
        """What a query looks like, in terms of what the images are described by; at most 2048 rows count."""
        ...


@runtime_checkable
class WholeImageExtractor(Protocol):
    """An extractor without keypoints, which provides its own way to match a query with reference images."""

    def reference_matching(self, map: Map) -> ReferenceMatching:
        """Prepare matching for a map that this extractor built."""
        ...


def matching_with(map: Map, options: MatchingOptions, cached: int | None = None) -> ReferenceMatching:
    """The way of matching that the options ask for.

    Args:
        map: The map.
        options: What matches.
        cached: Images of which what there is to match is kept in memory; None: all.

    Raises:
        InputError: There is no such matcher, or it cannot match features of the map's kind.
    """
    extractor = map.info.extractor
    if not map.has_keypoints and options.matcher in ("auto", extractor):
        made = load_extractor(extractor, map.info.extractor_options)
        if isinstance(made, WholeImageExtractor):
            return made.reference_matching(map)
        raise InputError(f"extractor {extractor!r} finds no keypoints and has no `reference_matching`")
    if options.matcher in ("auto", "nearest"):
        return NearestMatching(map, map.descriptor_metric, cached)
    return PairMatching(map, load_matcher(options.matcher, extractor), cached)


class NearestMatching:
    """Matches descriptors by their distance, just with keypoints that see a point of the map.

    A match to any other keypoint gives the pose nothing.
    """

    def __init__(self, map: Map, options: NearestOptions, cached: int | None) -> None:
        self._options = options
        names = list(map.images)
        self._target = lru_cache(cached)(lambda row: reference_target(map, names[row]))
        for row in range(len(names) if cached is None else 0):
            self._target(row)  # read now, not when the first query comes

    def match(self, query: Query, row: int, strongest: int | None) -> PointMatches:
        """Match a query's descriptors with those of an image."""
        return match_target(query.descriptors[:strongest], self._target(row), self._options, references=1)

    def target(self, row: int) -> Target:
        """What the image sees."""
        return self._target(row)

    def describe(self, query: Query) -> Descriptors:
        """The query's own descriptors."""
        return query.descriptors


class PairMatching:
    """Matches features by a network that looks at those of both images; just those that see a point."""

    def __init__(self, map: Map, matcher: Matcher, cached: int | None) -> None:
        self._matcher = matcher
        self._points = [seen.points for seen in map.observations.values()]
        names = list(map.images)
        self._seeing = lru_cache(cached)(lambda row: _seeing(map, names[row]))
        for row in range(len(names) if cached is None else 0):
            self._seeing(row)  # read now, not when the first query comes

    def match(self, query: Query, row: int, strongest: int | None) -> PointMatches:  # noqa: ARG002
        """Match all of a query's features with those of an image."""
        pairs = self._matcher.match(query.features, self._seeing(row))
        return PointMatches(keypoints=pairs[:, 0], points=self._points[row][pairs[:, 1]], references=1)

    def target(self, row: int) -> Target:
        """What the image sees."""
        return unit_rows(self._seeing(row).descriptors), self._points[row]

    def describe(self, query: Query) -> Descriptors:
        """The query's own descriptors."""
        return query.descriptors


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
