"""Match a query with one reference image: by nearest descriptors, by a network, or without keypoints."""

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
    """Matches queries with the reference images of one map, which are numbered in order of name."""

    def match(self, query: Query, row: int, strongest: int | None) -> PointMatches:
        """Match a query with an image.

        Args:
            query: The query.
            row: The image.
            strongest: Match only this many of the query's strongest keypoints, if the matcher matches
                keypoints one by one; None for all.
        """
        ...

    def target(self, row: int) -> Target:
        """Descriptors and points that the image sees."""
        ...

    def describe(self, query: Query) -> Descriptors:
        """Local descriptors of a query, of the kind that the images' global descriptors are made from.

        Only the first 2048 rows are used.
        """
        ...


@runtime_checkable
class WholeImageExtractor(Protocol):
    """An extractor without keypoints, which provides its own way to match a query with reference images."""

    def reference_matching(self, map: Map) -> ReferenceMatching:
        """Prepare matching for a map that this extractor built."""
        ...


def matching_with(map: Map, options: MatchingOptions, cached: int | None = None) -> ReferenceMatching:
    """Create the matching that the options ask for.

    Args:
        map: The map.
        options: Which matcher.
        cached: Number of images whose descriptors stay in memory; None for all.

    Raises:
        InputError: The matcher is unknown, or cannot match features of the map's kind.
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
    """Matches descriptors by their distance, only with keypoints that see a point of the map.

    Matches with other keypoints do not contribute to the pose.
    """

    def __init__(self, map: Map, options: NearestOptions, cached: int | None) -> None:
        self._options = options
        names = list(map.images)
        self._target = lru_cache(cached)(lambda row: reference_target(map, names[row]))
        for row in range(len(names) if cached is None else 0):
            self._target(row)  # read now, not for the first query

    def match(self, query: Query, row: int, strongest: int | None) -> PointMatches:
        """Match a query's descriptors with those of an image."""
        return match_target(query.descriptors[:strongest], self._target(row), self._options, references=1)

    def target(self, row: int) -> Target:
        """Descriptors and points that the image sees."""
        return self._target(row)

    def describe(self, query: Query) -> Descriptors:
        """The query's own descriptors."""
        return query.descriptors


class PairMatching:
    """Matches features by a network that sees those of both images; only keypoints that see a point."""

    def __init__(self, map: Map, matcher: Matcher, cached: int | None) -> None:
        self._matcher = matcher
        self._points = [seen.points for seen in map.observations.values()]
        names = list(map.images)
        self._seeing = lru_cache(cached)(lambda row: _seeing(map, names[row]))
        for row in range(len(names) if cached is None else 0):
            self._seeing(row)  # read now, not for the first query

    def match(self, query: Query, row: int, strongest: int | None) -> PointMatches:  # noqa: ARG002
        """Match all of a query's features with those of an image."""
        pairs = self._matcher.match(query.features, self._seeing(row))
        return PointMatches(keypoints=pairs[:, 0], points=self._points[row][pairs[:, 1]], references=1)

    def target(self, row: int) -> Target:
        """Descriptors and points that the image sees."""
        return unit_rows(self._seeing(row).descriptors), self._points[row]

    def describe(self, query: Query) -> Descriptors:
        """The query's own descriptors."""
        return query.descriptors


def _seeing(map: Map, name: str) -> Features:
    return map.features[name][map.observations[name].rows]


def reference_target(map: Map, name: str) -> Target:
    """Descriptors and points that a reference image sees."""
    return unit_rows(_seeing(map, name).descriptors), map.observations[name].points


def match_target(
    descriptors: Descriptors, target: Target, options: NearestOptions, references: int = 0
) -> PointMatches:
    """Match descriptors of a query with those of a target by nearest neighbors."""
    target_descriptors, points = target
    pairs = match_nearest(descriptors, target_descriptors, options)
    return PointMatches(keypoints=pairs[:, 0], points=points[pairs[:, 1]], references=references)
