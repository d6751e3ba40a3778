"""Localize queries of known pose against a map and variants of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import pycolmap

from slimsfm.datasets.onepose import PosedSequence
from slimsfm.evaluation.metrics import PoseError, pose_error, score
from slimsfm.evaluation.table import Row
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
        Query(path=path, camera=sequence.camera, cam_from_world=pose)
        for path, pose in zip(sequence.image_paths, sequence.cam_from_world, strict=True)
    ]


def held_out_queries(truth: Map, images: Path, names: Sequence[str]) -> list[Query]:
    """Images of a map, in a folder, as queries whose poses in the map are taken for true."""
    return [
        Query(
            path=images / name,
            camera=truth.camera(name),
            cam_from_world=truth.images[name].cam_from_world(),
        )
        for name in names
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


@dataclass(frozen=True, kw_only=True)
class Label:
    """What a row of a table is about."""

    object: str
    """Name of the object or scene."""

    strategy: str
    """How queries are matched."""

    matcher: str = "auto"
    """What matches a query and a reference image."""

    variant: str
    """Name of the variant that the map is."""


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


def _localize(localizer: Localizer, prepared: PreparedQuery) -> Localization:
    image = read_image(prepared.query.path) if localizer.looks_at_images else None
    found = localizer.localize_features(prepared.features, prepared.query.camera, image=image)
    return replace(found, seconds=replace(found.seconds, extract=prepared.extract_seconds))


def errors_of(map: Map, queries: Sequence[PreparedQuery], found: Sequence[Localization]) -> list[PoseError]:
    """Compare what was found with the truth."""
    return [
        pose_error(one.pose and one.pose.cam_from_world, prepared.query.cam_from_world, map.box)
        for prepared, one in zip(queries, found, strict=True)
    ]


def evaluate(
    map: Map,
    queries: Sequence[PreparedQuery],
    label: Label,
    *,
    map_bytes: int,
    progress: ProgressBar = silent,
) -> Row:
    """Localize queries against one map and sum up.

    Args:
        map: The map.
        queries: The queries.
        label: What it is about.
        map_bytes: Size of the map on disk.
        progress: Told of each query.
    """
    found = localize_all(map, queries, label.strategy, label.matcher, progress)
    return row_of(map, queries, found, label, map_bytes=map_bytes)


def row_of(
    map: Map,
    queries: Sequence[PreparedQuery],
    found: Sequence[Localization],
    label: Label,
    *,
    map_bytes: int,
) -> Row:
    """Sum up what localizing queries against one map gave; arguments as of `evaluate`."""
    errors = errors_of(map, queries, found)
    return Row(
        object=label.object,
        strategy=label.strategy,
        variant=label.variant,
        references=len(map.images),
        points=len(map.point3D_ids),
        map_bytes=map_bytes,
        scores=score(errors, found, metric=map.info.unit == "metre"),
    )
