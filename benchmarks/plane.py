"""Map size, time per query and accuracy of every strategy on full and reduced maps, in one run.

    python benchmarks/plane.py PHOTOS [PHOTOS ...] -o /tmp/plane

Queries are in no map. Each strategy localizes all of them, one after the other, after one without timing;
retrieval with 1 to 10 images. Ends with a summary: the speedup of progressive on the full map and of direct
on the reduced map over exhaustive on the full map, and their loss.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmark_scenes import Scene, scenes
from deceptive_scenes import deceptions
from slimsfm.evaluation.scores import SURE
from slimsfm.geometry import ADD_FRACTIONS, corner_error
from slimsfm.graph import GraphOptions, compute_graph
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.strategy import MatchingOptions
from slimsfm.mapping import Map, keep_images, read_map, write_map
from slimsfm.mapping.io import bytes_by_part
from slimsfm.progress import shown
from slimsfm.reduction import DominatingSetOptions, dominating_set, reduce
from slimsfm.synthetic.objects import OBJECTS

RETRIEVED = (1, 2, 3, 5, 10)


@dataclass(frozen=True, kw_only=True)
class Result:
    """Scores of one map and strategy."""

    scene: str
    map: str
    strategy: str
    bytes: int
    ms_match: float
    ms_pose: float
    add: tuple[float, ...]
    right: tuple[bool, ...]
    sure: int
    sure_and_wrong: int
    tried: float

    @property
    def ms(self) -> float:
        """Time of matching and pose estimation, in milliseconds."""
        return self.ms_match + self.ms_pose


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--objects", nargs="*", default=sorted(OBJECTS))
    parser.add_argument("--deceptive", action="store_true", help="the scenes that deceive, too")
    parser.add_argument("--brief", action="store_true", help="just what the targets speak of")
    arguments = parser.parse_args()
    results: list[Result] = []
    for scene in all_scenes(arguments):
        for result in measure(scene, arguments.output / "reduced", brief=arguments.brief):
            results.append(result)
            print(line(result), flush=True)
    (arguments.output / "plane.json").write_text(json.dumps([asdict(one) for one in results], indent=1))
    sum_up(results)


def all_scenes(arguments: argparse.Namespace) -> Iterator[Scene]:
    """The requested scenes."""
    yield from scenes(arguments.folders, arguments.objects, arguments.output)
    if arguments.deceptive:
        yield from deceptions(arguments.output)


def measure(scene: Scene, folder: Path, *, brief: bool) -> Iterator[Result]:
    """Run every strategy on every map."""
    full, points = scene.references, folder / f"{scene.name}-points"
    if not points.exists():
        write_map(reduce(full, progress=shown).map, points)
    kinds = [("exhaustive", 1), *(("retrieval", k) for k in ((2,) if brief else RETRIEVED))]
    kinds += [("progressive", 1), ("direct", 1)]
    maps = {"full": (full, scene.bytes)}
    if not brief:
        maps["images"] = stored(dominating(full), folder / f"{scene.name}-images")
    for name, (map_, size) in maps.items():
        for strategy, retrieved in kinds:
            matching = MatchingOptions(retrieved=retrieved)
            yield tried(scene, (name, map_, size), LocalizationOptions(strategy=strategy, matching=matching))
    slim = read_map(points)
    size = bytes_by_part(points)["total"]
    yield tried(scene, ("points", slim, size), LocalizationOptions(strategy="direct"))


def dominating(full: Map) -> Map:
    """The smallest dominating set of images."""
    graph = compute_graph(full, GraphOptions()).graph
    chosen = dominating_set(graph, DominatingSetOptions(), full).chosen
    return keep_images(full, [graph.names[i] for i in chosen])


def stored(made: Map, path: Path) -> tuple[Map, int]:
    """A map as read from disk, and its size there."""
    write_map(made, path, overwrite=True)
    return read_map(path), bytes_by_part(path)["total"]


def tried(scene: Scene, named: tuple[str, Map, int], options: LocalizationOptions) -> Result:
    """Localize all queries of a scene."""
    name, map_, size = named
    localizer = Localizer(map_, options)
    localizer.localize_features(scene.queries[0].features, scene.queries[0].query.camera)
    found = [localizer.localize_features(one.features, one.query.camera) for one in scene.queries]
    errors = np.array(
        [
            corner_error(one.pose.cam_from_world, prepared.query.cam_from_world, scene.references.box)
            if one.pose
            else np.inf
            for one, prepared in zip(found, scene.queries, strict=True)
        ]
    )
    sure = np.array([one.pose is not None and (one.pose.confidence or 0) > SURE for one in found])
    many = options.strategy == "retrieval"
    return Result(
        scene=scene.name,
        map=name,
        strategy=f"retrieval-{options.matching.retrieved}" if many else options.strategy,
        bytes=size,
        ms_match=1e3 * float(np.mean([one.seconds.match for one in found])),
        ms_pose=1e3 * float(np.mean([one.seconds.pose for one in found])),
        add=tuple(100 * float(np.mean(errors < fraction)) for fraction in ADD_FRACTIONS),
        right=tuple((errors < ADD_FRACTIONS[0]).tolist()),
        sure=int(sure.sum()),
        sure_and_wrong=int(np.sum(sure & (errors >= ADD_FRACTIONS[0]))),
        tried=float(np.mean([one.references for one in found])),
    )


def line(one: Result) -> str:
    """One row of the table."""
    shares = " ".join(f"{share:5.1f}" for share in one.add)
    return (
        f"{one.scene:14} {one.map:7} {one.strategy:12} {one.bytes / 1000:8.0f} kB  {shares}  "
        f"{one.ms_match:7.2f} + {one.ms_pose:5.2f} ms  {one.tried:5.1f} references  "
        f"{one.sure_and_wrong} wrong of {one.sure} sure"
    )


def sum_up(results: list[Result]) -> None:
    """Print the figures that have targets."""
    by_key = {(one.scene, one.map, one.strategy): one for one in results}
    aims = (("full", "progressive", 20), ("points", "direct", 60))
    for map_, strategy, aim in aims:
        ratios = []
        for name in dict.fromkeys(one.scene for one in results):
            base, one = by_key[name, "full", "exhaustive"], by_key[name, map_, strategy]
            retrieval = by_key[name, "full", "retrieval-2"]
            ratios.append(base.ms / one.ms)
            lost = " ".join(f"{a - b:5.1f}" for a, b in zip(base.add, one.add, strict=True))
            both = np.sum(np.array(base.right) & np.array(one.right)) / max(sum(base.right), 1)
            print(
                f"{strategy} on {map_}, {name:14}: {ratios[-1]:6.1f}x faster than exhaustive (target {aim}), "
                f"{retrieval.ms / one.ms:5.1f}x than retrieval top-2; lost {lost} (targets 0.5 0.5 2); "
                f"right in {both:.1%} of where exhaustive is"
            )
        mean = np.exp(np.mean(np.log(ratios)))
        print(f"{strategy} on {map_}: {mean:.0f}x on average, least {min(ratios):.1f}x")


if __name__ == "__main__":
    main()
