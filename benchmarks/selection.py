"""Every way to choose what to keep, on photos and rendered objects: accuracy, size, time, forecasts.

    python benchmarks/selection.py PHOTOS [PHOTOS ...] -o /tmp/selection

Each folder of photos is reconstructed once, with every third photo held out; six objects are rendered. All
choices localize the same queries, which are in no map, in this process, one after the other.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmark_scenes import Scene, scenes
from slimsfm.evaluation.results import evaluate
from slimsfm.evaluation.scores import score
from slimsfm.graph import GraphOptions, compute_graph
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.mapping import Map, keep_images, read_map, write_map
from slimsfm.mapping.io import bytes_by_part
from slimsfm.progress import shown
from slimsfm.reduction import (
    Choice,
    DominatingSetOptions,
    Prediction,
    Trials,
    apply_choice,
    dominating_set,
    reduce,
)
from slimsfm.selection import SELECTORS
from slimsfm.selection.usable_points import LeftOut, selection_problem
from slimsfm.synthetic.objects import OBJECTS

BUDGETS = (100, 200, 400, 800, 1600, 3200)
SEEDS = range(5)
BY_CHANCE = ("random",)
IMAGE_SETS = {
    "paper": {"solver": "random"},
    "smallest": {},
    "k = 2": {"dominators": 2},
    "k = 3": {"dominators": 3},
    "rim": {"rim": True},
    "k = 2, rim": {"dominators": 2, "rim": True},
}


@dataclass(frozen=True, kw_only=True)
class Result:
    """Scores of one map and strategy."""

    scene: str
    method: str
    strategy: str
    seed: int
    images: int
    points: int
    bytes: int
    add: tuple[float, float, float]
    median: float
    ms: float
    predicted: float | None


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--objects", nargs="*", default=sorted(OBJECTS))
    parser.add_argument("--brief", action="store_true", help="just the full map and what plain reduce gives")
    arguments = parser.parse_args()
    results: list[Result] = []
    for scene in scenes(arguments.folders, arguments.objects, arguments.output):
        for result in measure(scene, arguments.output / "slim", brief=arguments.brief):
            results.append(result)
            print(line(result), flush=True)
    (arguments.output / "selection.json").write_text(json.dumps([asdict(one) for one in results], indent=1))
    sum_up(results)


def measure(scene: Scene, slim: Path, *, brief: bool) -> Iterator[Result]:
    """Measure the full map, the default of reduce, points by every selector, and image sets."""
    full = scene.references
    for strategy in ("exhaustive", "direct"):
        yield tried(scene, full, scene.bytes, "full", strategy)
    best = reduce(full, progress=shown)
    predicted = best.forecast["direct"].prediction
    yield tried(scene, *stored(best.map, slim), "default", "direct", predicted)
    if not brief:
        yield from selected(scene, slim)
        yield from image_sets(scene, slim)


def selected(scene: Scene, slim: Path) -> Iterator[Result]:
    """Points by every selector."""
    left_out = LeftOut(scene.references)
    trials, described = Trials(scene.references, left_out), describe_points(scene.references)
    problem = selection_problem(scene.references, left_out)
    for name, select in SELECTORS.items():
        for budget in BUDGETS:
            for seed in SEEDS if name in BY_CHANCE else (0,):
                points = np.sort(select(problem, budget, seed=seed))
                if len(points) < budget:
                    continue
                choice = Choice(use="direct", method=name, detail="", images=(), points=points)
                made = stored(apply_choice(scene.references, choice, described=described), slim)
                yield tried(scene, *made, name, "direct", trials.points(points), seed=seed)


def image_sets(scene: Scene, slim: Path) -> Iterator[Result]:
    """Dominating sets of images, matched by image and directly."""
    full = scene.references
    graph = compute_graph(full, GraphOptions(edges="localize", candidates="all")).graph
    trials = Trials(full, LeftOut(full))
    for name, options in IMAGE_SETS.items():
        for seed in SEEDS if name == "paper" else (0,):
            chosen = dominating_set(graph, DominatingSetOptions(seed=seed, **options), full).chosen
            images = [graph.names[i] for i in chosen]
            made = stored(keep_images(full, images), slim)
            predicted = trials.images(images)
            yield tried(scene, *made, name, "exhaustive", predicted, seed=seed)
            yield tried(scene, *made, name, "direct", seed=seed)


def stored(made: Map, slim: Path) -> tuple[Map, int]:
    """A map as read from disk, and its size there."""
    write_map(made, slim, overwrite=True)
    return read_map(slim), bytes_by_part(slim)["total"]


def tried(
    scene: Scene,
    map_: Map,
    size: int,
    method: str,
    strategy: str,
    predicted: Prediction | None = None,
    seed: int = 0,
) -> Result:
    """Localize all queries of a scene."""
    scores = score(evaluate(map_, scene.queries, strategy), metric=False)
    seconds = scores.seconds
    return Result(
        scene=scene.name,
        method=method,
        strategy=strategy,
        seed=seed,
        images=len(map_.images) if map_.features else 0,
        points=len(map_.point3D_ids),
        bytes=size,
        add=tuple(scores.add.values()),
        median=scores.median_error,
        ms=1e3 * (seconds.match + seconds.pose),
        predicted=predicted.within(0.1) if predicted and predicted.tests else None,
    )


def line(one: Result) -> str:
    """One row of the table."""
    shares = " ".join(f"{share:5.1f}" for share in one.add)
    predicted = "" if one.predicted is None else f"  predicted {one.predicted:.1f}"
    return (
        f"{one.scene:12} {one.method:14} {one.strategy:10} {one.images:3d} images {one.points:6d} points "
        f"{one.bytes / 1000:8.0f} kB  {shares}  {1e3 * one.median:7.2f}e-3d {one.ms:8.2f} ms{predicted}"
    )


def sum_up(results: list[Result]) -> None:
    """Print the figures that have targets."""
    names = list(dict.fromkeys(one.scene for one in results))
    full = {one.scene: one for one in results if (one.method, one.strategy) == ("full", "exhaustive")}
    default = {one.scene: one for one in results if one.method == "default"}
    faster = [full[name].ms / default[name].ms for name in names]
    smaller = [full[name].bytes / default[name].bytes for name in names]
    print(f"default, direct: {mean(faster):.0f}x faster (target 60), least {min(faster):.0f}x (target 20)")
    print(f"default: {mean(smaller):.0f}x fewer bytes (target 100), least {min(smaller):.0f}x (target 50)")
    for name in names:
        lost = [a - b for a, b in zip(full[name].add, default[name].add, strict=True)]
        print(
            f"  {name:12} {full[name].ms / default[name].ms:5.0f}x faster, "
            f"{full[name].bytes / default[name].bytes:5.0f}x smaller, {default[name].points:5d} points, "
            f"lost {lost[0]:5.1f} {lost[1]:5.1f} {lost[2]:5.1f} (targets 0.5 0.5 1)"
        )
    predicted = [one for one in results if one.predicted is not None]
    for method in dict.fromkeys(one.method for one in predicted):
        off = np.mean([abs(one.predicted - one.add[0]) for one in predicted if one.method == method])
        print(f"predicted against true share within 0.1 d, {method}: {off:.1f} points off (target 3)")
    if any(one.method == "kcover" for one in results):
        share_of_points(results, names)


def share_of_points(results: list[Result], names: list[str]) -> None:
    """Number of points that `information` needs to match K-cover, for each of its budgets."""
    by_median, by_share = [], []
    for name in names:
        ours, theirs = (curve(results, name, method) for method in ("information", "kcover"))
        medians = np.minimum.accumulate([one.median for one in ours])
        shares = np.maximum.accumulate([one.add[2] for one in ours])
        for one in theirs:
            by_median.append(needed(ours, -medians, -one.median) / one.points)
            by_share.append(needed(ours, shares, one.add[2]) / one.points)
    for aim, ratios in (("median error", by_median), ("share within 0.02 d", by_share)):
        reached = [ratio for ratio in ratios if np.isfinite(ratio)]
        print(
            f"information reaches the {aim} of kcover with {mean(reached):.2f} of the points "
            f"({len(reached)} of {len(ratios)} reached; target 0.7)"
        )


def needed(curve: list[Result], goodness: np.ndarray, wanted: float) -> float:
    """Number of points at which a rising curve reaches a value, interpolated; infinite if it does not."""
    first = int(np.searchsorted(goodness, wanted))
    if first == len(curve):
        return np.inf
    if first == 0 or goodness[first] == goodness[first - 1]:
        return float(curve[first].points)
    if not np.isfinite(goodness[first - 1]):
        return float(curve[first].points)
    share = (wanted - goodness[first - 1]) / (goodness[first] - goodness[first - 1])
    low, high = np.log([curve[first - 1].points, curve[first].points])
    return float(np.exp(low + share * (high - low)))


def curve(results: list[Result], scene: str, method: str) -> list[Result]:
    """The results of one selector by number of points."""
    found = [one for one in results if (one.scene, one.method) == (scene, method)]
    return sorted(found, key=lambda one: one.points)


def mean(values: list[float]) -> float:
    """Geometric mean."""
    return float(np.exp(np.mean(np.log(values))))


if __name__ == "__main__":
    main()
