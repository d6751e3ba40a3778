"""A benchmark run of exact scenes, measured like the command does, in a second."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from scenes import exact_map, with_matches
from slimsfm.evaluation.benchmark import BenchmarkOptions
from slimsfm.evaluation.result_files import write_results
from slimsfm.evaluation.results import (
    MappedObject,
    MapRun,
    Measurement,
    ObjectResult,
    PosedQuery,
    PreparedQuery,
    Run,
    localize_all,
    outcomes_of,
)
from slimsfm.evaluation.variants import VariantInputs, parse_variant
from slimsfm.geometry import project
from slimsfm.graph import GraphOptions
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.mapping.io import read_map, weigh_map, write_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.mapping.support import measure
from slimsfm.reduction import DominatingSetOptions, dominating_set

_OPTIONS = BenchmarkOptions(strategies=("exhaustive", "direct"))
_HARD = 14  # keypoints of the last query, which reduced maps do not localize
_REACH_DEG = 55.0  # field of view: no image localizes all others


def make_run(folder: Path, objects: Mapping[str, int]) -> Run:
    """Measure objects with these numbers of images, every third one a query, and write the results."""
    run = Run(
        folder=folder,
        dataset="Exact scenes",
        options={**asdict(_OPTIONS), "command": "slimsfm benchmark exact -o run"},
        environment={"slimsfm": "0.1.0", "cpu": "a <fast> one"},
        objects=tuple(_measured(folder, name, count) for name, count in sorted(objects.items())),
        failed={"jug": "there is no photo"},
    )
    write_results(run)
    return run


def _measured(folder: Path, name: str, count: int) -> ObjectResult:
    truth = exact_map(count, 150, seed=count, reach_deg=_REACH_DEG)
    photos = folder / "photos" / name
    _photograph(truth, photos)
    names = list(truth.images)
    base = folder / "maps" / name / "sift"
    asked = names[1::3]
    write_map(keep_images(truth, [one for one in names if one not in asked]), base / "full")
    full = read_map(base / "full")
    graph = load_or_compute_graph(full, base / "full", GraphOptions(edges="localize", candidates="all")).graph
    solution = dominating_set(graph, DominatingSetOptions(), full)
    making = VariantInputs(map=full, graph=graph, reduction=DominatingSetOptions(), solution=solution)
    queries = [_query(truth, photos, one) for one in asked]
    prepared = [_prepared(query, truth, hard=query is queries[-1]) for query in queries]
    stored = {variant: _stored(making, variant, base) for variant in _OPTIONS.variants}
    chosen = tuple(graph.names[i] for i in solution.chosen)
    return ObjectResult(
        name=name,
        box=truth.box,
        unit="metre",
        images=photos,
        queries=tuple(queries),
        maps=(
            MappedObject(
                method="sift",
                references=len(full.images),
                points=len(full.point3D_ids),
                edges=graph.num_edges(),
                dominating_set=chosen,
                lower_bound=int(solution.lower_bound),
                dominating_points=len(stored["dominating"][0].point3D_ids),
                quality=replace(
                    measure(truth.model, with_matches(truth).matches, truth.images),
                    focal_origins={names[0]: "given"},
                ),
                notes=("a <raw> photo was skipped",),
            ),
        ),
        measurements=tuple(
            Measurement(
                method="sift",
                strategy=strategy,
                variant=variant,
                map_runs=tuple(_trial(one, strategy, prepared) for one in maps),
            )
            for strategy in _OPTIONS.strategies
            for variant, maps in stored.items()
            if strategy == "direct" or variant != "default"
        ),
    )


def _query(truth: Map, photos: Path, name: str) -> PosedQuery:
    cam_from_world = truth.images[name].cam_from_world()
    return PosedQuery(path=photos / name, camera=truth.camera(name), cam_from_world=cam_from_world)


def _prepared(query: PosedQuery, truth: Map, *, hard: bool) -> PreparedQuery:
    features = truth.features[query.path.name]
    seen = features[np.arange(_HARD)] if hard else features
    return PreparedQuery(query=query, features=seen, extract_seconds=0.01)


def _stored(making: VariantInputs, variant: str, base: Path) -> list[Map]:
    maps = parse_variant(variant).make(making)
    if variant in ("dominating", "default"):
        write_map(maps[0], base / variant)
    return maps


def _trial(map_: Map, strategy: str, prepared: list[PreparedQuery]) -> MapRun:
    truth = [one.query.cam_from_world for one in prepared]
    return MapRun(
        references=len(map_.images),
        points=len(map_.point3D_ids),
        map_bytes=weigh_map(map_),
        outcomes=outcomes_of(localize_all(map_, prepared, strategy), truth, map_.box),
    )


def _photograph(map_: Map, folder: Path) -> None:
    """Draw the points that each image of a map sees as discs on a plain background."""
    folder.mkdir(parents=True)
    for number, (name, image) in enumerate(map_.images.items()):
        camera = map_.camera(name)
        photo = np.full((camera.height, camera.width, 3), (60 + 15 * number, 120, 160), np.uint8)
        points = map_.points3D_in_world[map_.observations[name].points]
        for x, y in project(points, image.cam_from_world(), camera).round().astype(int).tolist():
            cv2.circle(photo, (x, y), 6, (230, 180, 40), -1)
        Image.fromarray(photo).save(folder / name)
