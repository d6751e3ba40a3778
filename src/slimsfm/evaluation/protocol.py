"""Localize queries of known pose against a map."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import pycolmap

from slimsfm.datasets.base import ObjectModel, PosedSequence
from slimsfm.evaluation.outcomes import Outcomes, outcomes_of
from slimsfm.features import Features, load_extractor
from slimsfm.localization import Localization, LocalizationOptions, Localizer
from slimsfm.localization.strategy import MatchingOptions
from slimsfm.mapping.map import Map
from slimsfm.photos import read_image
from slimsfm.progress import ProgressBar, silent


@dataclass(frozen=True, kw_only=True, eq=False)
class Query:
    """An image whose true pose is known."""

    path: Path
    """The image file."""

    camera: pycolmap.Camera
    """Its intrinsics."""

    cam_from_world: pycolmap.Rigid3d
    """Its true pose in the map's frame."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedQuery:
    """A query whose features are there already, for all variants and strategies use the same."""

    query: Query
    """The query."""

    features: Features
    """What the map's extractor finds in it."""

    extract_seconds: float
    """Time that took."""


def queries_of(sequence: PosedSequence) -> list[Query]:
    """The frames of a sequence as queries."""
    return [
        Query(path=path, camera=camera, cam_from_world=pose)
        for path, camera, pose in zip(
            sequence.image_paths, sequence.cameras, sequence.cam_from_world, strict=True
        )
    ]


def prepare(map: Map, queries: Sequence[Query], progress: ProgressBar = silent) -> list[PreparedQuery]:
    """Extract the features of queries with the map's extractor."""
    extractor = load_extractor(map.info.extractor, map.info.extractor_options)
    prepared = []
    for query in progress(queries, "extract query features"):
        image = read_image(query.path)
        start = perf_counter()
        features = extractor.extract(image)
        seconds = perf_counter() - start
        prepared.append(PreparedQuery(query=query, features=features, extract_seconds=seconds))
    return prepared


def localize_all(
    map: Map,
    queries: Sequence[PreparedQuery],
    strategy: str,
    matcher: str = "auto",
    progress: ProgressBar = silent,
) -> list[Localization]:
    """Localize queries one after the other, after one that is not timed and finds every cache cold.

    Raises:
        ValueError: There is no query.
    """
    if not queries:
        raise ValueError("queries must hold at least one query")
    options = LocalizationOptions(strategy=strategy, matching=MatchingOptions(matcher=matcher))
    localizer = Localizer(map, options)
    _localize(localizer, queries[0])
    return [_localize(localizer, query) for query in progress(queries, f"localize queries ({strategy})")]


def evaluate(
    map: Map,
    queries: Sequence[PreparedQuery],
    strategy: str,
    matcher: str = "auto",
    progress: ProgressBar = silent,
    model: ObjectModel | None = None,
) -> Outcomes:
    """Localize queries against a map and compare with the truth.

    Args:
        map: The map.
        queries: The queries.
        strategy: How they are matched.
        matcher: What matches images.
        progress: Told of each query.
        model: The object's model, where the data set has one.
    """
    found = localize_all(map, queries, strategy, matcher, progress)
    return outcomes_of(found, [one.query.cam_from_world for one in queries], map.box, model)


def _localize(localizer: Localizer, prepared: PreparedQuery) -> Localization:
    image = read_image(prepared.query.path) if localizer.looks_at_images else None
    found = localizer.localize_features(prepared.features, prepared.query.camera, image=image)
    return replace(found, seconds=replace(found.seconds, extract=prepared.extract_seconds))
