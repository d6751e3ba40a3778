"""Localize disturbed photos as a user would, and see whether the confidence keeps its word.

    python benchmarks/disturbed_queries.py -o /tmp/disturbed --photos ../shared/data

Every scene has a full map, localized in by `progressive`, and the slim map that `reduce` makes of it,
localized in by `direct`. Queries are in no map. Each is disturbed in every way of `disturbances.py`; clean
queries of the other scenes come besides. Maps, photos and features are stored in the output folder and
reused.

Writes table.md and records.json there, and prints the table.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from disturbed_examples import QUERIES, DisturbedQuery, examples
from disturbed_report import Record, report
from disturbed_scenes import NAMES, MappedScene, mapped_scene
from slimsfm.geometry import corner_error
from slimsfm.localization import Localization, LocalizationOptions, Localizer
from slimsfm.localization.cameras import query_camera
from slimsfm.mapping import Map
from slimsfm.progress import shown


class UserLocalizer:
    """Localizes a file with what its user believes. The one place that knows how cameras are chosen."""

    def __init__(self, map: Map, strategy: str) -> None:
        self._localizer = Localizer(map, LocalizationOptions(strategy=strategy, min_confidence=0))

    def localize(self, query: DisturbedQuery) -> Localization:
        """By the camera that is given or chosen."""
        camera = query_camera(self._localizer.map, query.path, query.believed)
        return self._localizer.localize_features(query.features, camera)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--photos", required=True, type=Path, help="folder with plush, fox, lund and office")
    parser.add_argument("--scenes", nargs="+", default=NAMES, choices=NAMES)
    parser.add_argument("--queries", type=int, default=QUERIES, help="queries per scene")
    parser.add_argument("--before", type=Path, help="records.json of an earlier version, to compare with")
    parser.add_argument(
        "--exhaustive", action="store_true", help="exhaustive matching with the full map, too"
    )
    arguments = parser.parse_args()
    scenes = [mapped_scene(name, arguments.photos, arguments.output) for name in arguments.scenes]
    before = read_records(arguments.before) if arguments.before else []
    records: list[Record] = []
    for scene in scenes:
        found = examples(scene, scenes, queries=arguments.queries)
        records += measured(scene, list(found), exhaustive=arguments.exhaustive)
        (arguments.output / "records.json").write_text(json.dumps([asdict(one) for one in records], indent=1))
    table = report(records, before)
    (arguments.output / "table.md").write_text(table)
    print(table)


def read_records(path: Path) -> list[Record]:
    """What an earlier version wrote."""
    return [Record(**one) for one in json.loads(path.read_text())]


def measured(scene: MappedScene, queries: Sequence[DisturbedQuery], *, exhaustive: bool) -> Iterator[Record]:
    """Localize all queries in both maps."""
    localizers = {
        "progressive, full": UserLocalizer(scene.full, "progressive"),
        "direct, slim": UserLocalizer(scene.slim, "direct"),
    }
    if exhaustive:
        localizers["exhaustive, full"] = UserLocalizer(scene.full, "exhaustive")
    for method, localizer in localizers.items():
        for query in shown(queries, f"{scene.name} ({method})"):
            yield record(scene, method, query, localizer.localize(query))


def record(scene: MappedScene, method: str, query: DisturbedQuery, found: Localization) -> Record:
    """What came of a query."""
    error = np.inf
    if found.pose and query.cam_from_world:
        error = corner_error(found.pose.cam_from_world, query.cam_from_world, scene.full.box)
    true_focal = query.camera.mean_focal_length()
    return Record(
        scene=scene.name,
        method=method,
        disturbance=query.disturbance,
        group=query.group,
        query=query.name,
        has_pose=query.cam_from_world is not None,
        confidence=float((found.pose and found.pose.confidence) or 0),
        error=float(error),
        bound=found.pose.corner_bound(scene.full.box) if found.pose else None,
        relative_focal_error=float(found.camera.mean_focal_length() / true_focal - 1),
        inliers=found.pose.num_inliers if found.pose else 0,
        milliseconds=1000 * (found.seconds.match + found.seconds.pose),
    )


if __name__ == "__main__":
    main()
