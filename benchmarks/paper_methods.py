"""The four methods of the paper on a rendered object: full map, dominating set, random set; time by stage.

    python benchmarks/paper_methods.py -o OUT [--weights WEIGHTS] [--object boulder] [--queries 4]

Weights that are not in WEIGHTS are random with a fixed seed. Untrained networks find no matches to build a
map from, so the map is then the SIFT map of the object with descriptors of the method at its keypoints. With
random weights only times are meaningful, and no accuracy is printed.
"""

import argparse
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmark_scenes import rendered
from random_weights import write_random_weights
from slimsfm.cli.output import quiet
from slimsfm.datasets.base import ObjectSequences, map_object
from slimsfm.datasets.onepose import read_object
from slimsfm.evaluation.results import (
    Outcomes,
    PreparedQuery,
    evaluate,
    join_outcomes,
    outcomes_of,
    prepare_queries,
    queries_of,
)
from slimsfm.evaluation.scores import Scores, score
from slimsfm.features import Features
from slimsfm.graph import GraphOptions, compute_graph
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.mapping import Map, read_map, write_map
from slimsfm.mapping.build import BuildOptions
from slimsfm.mapping.io import shrink_photo
from slimsfm.mapping.subset import keep_images
from slimsfm.methods.loftr.matcher import Loftr
from slimsfm.methods.superpoint import SuperPoint, describe_pixels
from slimsfm.photos import read_image
from slimsfm.reduction import DominatingSetOptions, dominating_set, keep_random_images
from slimsfm.weight_files import WEIGHTS
from slimsfm.weights import Runtime, use_runtime


@dataclass(frozen=True, kw_only=True)
class Method:
    """One of the four methods of the paper."""

    name: str
    strategy: str
    matcher: str = "auto"
    extractor: str = "superpoint"
    weights: tuple[str, ...]
    paper: float  # frames a second with the dominating set over those with the full map
    is_box_given: bool = False  # as in the paper: queries are cropped to where the object is known to be


_ONEPOSE = Method(
    name="OnePose, first frame",
    strategy="onepose",
    weights=("superpoint", "superglue", "onepose"),
    paper=40.67 / 27.39,
)
_ONEPOSE_PLUS = Method(
    name="OnePose++, first frame",
    strategy="onepose++",
    extractor="loftr",
    weights=("loftr-onepose++", "onepose++"),
    paper=19.12 / 12.75,
)
METHODS = (
    replace(_ONEPOSE, name="OnePose", is_box_given=True),
    _ONEPOSE,
    replace(_ONEPOSE_PLUS, name="OnePose++", is_box_given=True),
    _ONEPOSE_PLUS,
    Method(
        name="exhaustive SuperGlue",
        strategy="exhaustive",
        matcher="superglue",
        weights=("superpoint", "superglue"),
        paper=6.66 / 1.40,
    ),
    Method(
        name="exhaustive LightGlue",
        strategy="exhaustive",
        matcher="lightglue",
        weights=("superpoint", "superglue", "lightglue-superpoint"),
        paper=26.20 / 1.81,
    ),
)


Describe = Callable[[np.ndarray, Features], np.ndarray]


def main() -> None:
    """Run all methods and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--object", default="boulder")
    parser.add_argument("--queries", default=4, type=int)
    parser.add_argument("--methods", nargs="+", default=[one.name for one in METHODS])
    arguments = parser.parse_args()
    trained = _weights(arguments.output / "weights", arguments.weights)
    sift = rendered(arguments.object, arguments.output).references
    made = read_object(arguments.output / "objects" / arguments.object)
    print(f"{torch.get_num_threads()} threads, {'a GPU' if torch.cuda.is_available() else 'no GPU'}")
    for method in (one for one in METHODS if one.name in arguments.methods):
        if trained.issuperset(method.weights):
            map_ = _built(made, method)
        else:
            map_ = _described(sift, made, method.extractor)
        rows = _rows(method, map_, made, arguments.output, arguments.queries)
        _print(method, rows, is_trained=trained.issuperset(method.weights))


def _weights(folder: Path, given: Path | None) -> set[str]:
    """Fill a folder with random weights, then with the given ones; return the names of the given ones."""
    write_random_weights(folder)
    found = {name for name, one in WEIGHTS.items() if given and (given / one.file).is_file()}
    for name in found:
        shutil.copy(given / WEIGHTS[name].file, folder)  # pyright: ignore[reportOptionalOperand]
    use_runtime(Runtime(weights=folder))
    return found


def _built(made: ObjectSequences, method: Method) -> Map:
    matcher = "superglue" if method.extractor == "superpoint" else "nearest"
    with quiet(), tempfile.TemporaryDirectory() as workspace:
        options = BuildOptions(extractor=method.extractor, matcher=matcher)
        return map_object(made, Path(workspace), options)


def _described(map_: Map, made: ObjectSequences, extractor: str) -> Map:
    """The map with descriptors of another method at its keypoints."""
    photos = {path.name: read_image(path) for path in made.mapping.image_paths if path.name in map_.images}
    describe = _by_superpoint() if extractor == "superpoint" else _by_loftr()
    features = {
        name: replace(map_.features[name], descriptors=describe(photo, map_.features[name]))
        for name, photo in photos.items()
    }
    options = {"weights": "loftr-onepose++"} if extractor == "loftr" else {}
    info = replace(map_.info, extractor=extractor, extractor_options=options)
    small = {name: shrink_photo(photo, 640) for name, photo in photos.items()} if options else {}
    return replace(map_, features=features, info=info, photos=small, global_descriptors=None)


def _by_superpoint() -> Describe:
    maps = SuperPoint().maps

    def describe(photo: np.ndarray, features: Features) -> np.ndarray:
        gray = torch.from_numpy(photo).float().mean(dim=2)[None, None] / 255
        pixels = torch.from_numpy(np.round(features.keypoints - 0.5).astype(np.int64))
        with torch.inference_mode():
            return describe_pixels(maps(gray)[1], pixels).numpy().astype(np.float16)

    return describe


def _by_loftr() -> Describe:
    matcher = Loftr(weights="loftr-onepose++")
    return lambda photo, features: matcher.describe(
        matcher.encode(photo), features.keypoints.astype(np.float64)
    )


@dataclass(frozen=True, kw_only=True)
class Row:
    """Results of one method on one variant of a map."""

    references: float
    points: float
    scores: Scores


def _rows(method: Method, map_: Map, made: ObjectSequences, output: Path, count: int) -> dict[str, Row]:
    graph = compute_graph(map_, GraphOptions(edges="matches")).graph
    names, chosen = list(map_.images), dominating_set(graph, DominatingSetOptions()).chosen
    variants: Mapping[str, list[Map]] = {
        "full": [map_],
        "dominating": [keep_images(map_, (names[i] for i in chosen))],
        "random": [keep_random_images(map_, len(chosen), seed=seed) for seed in range(3)],
    }
    step = max(1, len(made.query.image_paths) // count)
    queries, rows = prepare_queries(map_, queries_of(made.query)[::step][:count]), {}
    for variant, maps in variants.items():
        stored = [_stored(one, output / "map") for one in maps]
        run = _with_boxes if method.is_box_given else evaluate
        outcomes = [run(one, queries, method.strategy, method.matcher) for one in stored]
        rows[variant] = Row(
            references=float(np.mean([len(one.images) for one in stored])),
            points=float(np.mean([len(one.point3D_ids) for one in stored])),
            scores=score(join_outcomes(outcomes), metric=True, draws=len(stored)),
        )
    return rows


def _with_boxes(map_: Map, queries: list[PreparedQuery], strategy: str, _matcher: str) -> Outcomes:
    """Localize queries near their true poses, after one without timing."""
    localizer = Localizer(map_, LocalizationOptions(strategy=strategy))
    found = [
        localizer.localize_near(read_image(one.path), one.camera, one.cam_from_world)
        for one in (prepared.query for prepared in (queries[0], *queries))
    ][1:]
    return outcomes_of(found, [one.query.cam_from_world for one in queries], map_.box)


def _stored(map_: Map, path: Path) -> Map:
    write_map(map_, path, overwrite=True)
    return read_map(path)


def _print(method: Method, rows: Mapping[str, Row], *, is_trained: bool) -> None:
    full = rows["full"].scores.seconds
    for variant, row in rows.items():
        seconds = row.scores.seconds
        stages = f"{seconds.extract:6.2f} s {seconds.match:7.2f} s {seconds.pose:6.3f} s"
        matching = (full.match + full.pose) / (seconds.match + seconds.pose)
        ratios = f"{full.total / seconds.total:5.1f}x {matching:6.1f}x"
        paper = f"{method.paper:5.1f}x" if variant == "dominating" else " " * 6
        found = f"ADD-0.1d {row.scores.add[0.1]:.1f}" if is_trained else "random weights"
        size = f"{row.references:4.0f} images {row.points:6.0f} points"
        print(f"{method.name:<22} {variant:<11} {size} {stages} {ratios} {paper}  {found}", flush=True)


if __name__ == "__main__":
    main()
