"""How long a query takes from its file to its pose, with features in rounds and from the whole image at once.

    python benchmarks/end_to_end.py PHOTOS [PHOTOS ...] --objects boulder can -o /tmp/scenes

A folder of photos is split as everywhere: every third photo is a query. A folder with a `transforms.json` has
true poses, the poses of other photos come from a reconstruction of all of them. The ways take turns, once
forward and once backward, in one run, on all cores: the default reduced map and the full map, each with
`--extraction rounds` and `--extraction whole`, and the full map matched exhaustively. Times are medians,
shares are of queries. The forecast of the median time with the reduced map, as `reduce` prints it, is
compared with what is measured.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from statistics import geometric_mean
from time import perf_counter

import numpy as np
from jaxtyping import Float64

from benchmark_scenes import Scene, rendered, scenes
from deceptive_scenes import deception
from posed_scenes import posed
from slimsfm.arrays import evenly_spaced
from slimsfm.evaluation.results import PosedQuery, outcomes_of
from slimsfm.localization import Localization, LocalizationOptions, Localizer
from slimsfm.mapping import Map, read_map, write_map
from slimsfm.photos import read_photo
from slimsfm.progress import shown
from slimsfm.reduction import measure_speed, reduce

WAYS = {
    "slim, whole": ("slim", LocalizationOptions(extraction="whole")),
    "slim, rounds": ("slim", LocalizationOptions()),
    "full, whole": ("full", LocalizationOptions(extraction="whole")),
    "full, rounds": ("full", LocalizationOptions()),
    "full, exhaustive": ("full", LocalizationOptions(extraction="whole", strategy="exhaustive")),
}
FRACTIONS = 0.1, 0.05, 0.02
METRIC = (0.05, 5.0), (0.01, 1.0)  # meters and degrees


@dataclass(frozen=True, kw_only=True)
class Row:
    """What one way gave on one scene."""

    scene: str
    way: str
    decode_ms: float
    query_ms: float
    extract_ms: float
    match_ms: float
    pose_ms: float
    mean_ms: float
    shares: tuple[float, ...]
    median_error: float
    p90_error: float
    metric: tuple[float, ...]
    median_position: float
    confident_wrong: int
    queries: int


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*", help="folders of photos")
    parser.add_argument("--objects", nargs="*", default=[], help="rendered objects")
    parser.add_argument("--deceptions", nargs="*", default=[], help="deceptive scenes, see deception.py")
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("--most", type=int, default=40, help="queries per scene, evenly spaced")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for maps")
    options = parser.parse_args()
    rows: list[Row] = []
    print(f"{HEADER}\n|{13 * '---|'}")
    made = chain(
        _scenes(options.folders, options.objects, options.output),
        (deception(name, options.output) for name in options.deceptions),
    )
    for scene in made:
        measured = _measured(scene, options.ways, options.most, options.output)
        rows += measured
        for row in measured:
            _print(row)
        _print_forecast(scene, measured, options.output)
    _summarize(rows)
    (options.output / "end_to_end.json").write_text(json.dumps([vars(row) for row in rows], indent=1))


def _scenes(folders: list[Path], objects: list[str], output: Path) -> Iterator[Scene]:
    for folder in folders:
        has_poses = (folder / "transforms.json").is_file()
        yield from [posed(folder, output)] if has_poses else scenes([folder], [], output)
    for name in objects:
        yield rendered(name, output)


def _measured(scene: Scene, ways: list[str], most: int, output: Path) -> list[Row]:
    maps = {"full": scene.references, "slim": _slim(scene, output)}
    localizers = {way: Localizer(maps[WAYS[way][0]], WAYS[way][1]) for way in ways}
    places = evenly_spaced(len(scene.queries), most)
    queries = [scene.queries[place].query for place in places.tolist()]
    found: dict[str, list[_Timed]] = {way: [] for way in ways}
    for way in shown((*ways, *reversed(ways)), scene.name):
        _localized(localizers[way], queries[0])  # fills caches, and lets threads of the last way settle
        found[way] += [_localized(localizers[way], one) for one in queries]
    return [_row(scene, way, 2 * queries, found[way]) for way in ways]


def _slim(scene: Scene, output: Path) -> Map:
    path = output / f"{scene.name}-slim"
    if not path.exists():
        write_map(reduce(scene.references, progress=shown).map, path)
    return read_map(path)


@dataclass(frozen=True)
class _Timed:
    localization: Localization
    decode: float
    query: float


def _localized(localizer: Localizer, query: PosedQuery) -> _Timed:
    start = perf_counter()
    photo = read_photo(query.path, query.orientation, warn=False)
    decoded = perf_counter()
    found = localizer.localize(photo.image, query.camera, mask=photo.visible)
    return _Timed(found, decoded - start, perf_counter() - decoded)


def _median_ms(seconds: list[float] | Float64[np.ndarray, " n"]) -> float:
    return 1e3 * float(np.median(seconds))


def _row(scene: Scene, way: str, queries: list[PosedQuery], found: list[_Timed]) -> Row:
    outcomes = outcomes_of(
        [one.localization for one in found], [one.cam_from_world for one in queries], scene.references.box
    )
    centers = [
        np.inf
        if pose is None
        else float(np.linalg.norm(pose.inverse().translation - one.cam_from_world.inverse().translation))
        for pose, one in zip(outcomes.cam_from_world, queries, strict=True)
    ]
    return Row(
        scene=scene.name,
        way=way,
        decode_ms=_median_ms([one.decode for one in found]),
        query_ms=_median_ms([one.query for one in found]),
        extract_ms=_median_ms(outcomes.seconds[:, 0]),
        match_ms=_median_ms(outcomes.seconds[:, 1]),
        pose_ms=_median_ms(outcomes.seconds[:, 2]),
        mean_ms=1e3 * float(np.mean([one.query for one in found])),
        shares=tuple(100 * float(np.mean(outcomes.error < one)) for one in FRACTIONS),
        median_error=float(np.median(outcomes.error)),
        p90_error=float(np.quantile(outcomes.error, 0.9, method="higher")),
        metric=tuple(
            100 * float(np.mean((np.array(centers) < meters) & (outcomes.rotation_deg < degrees)))
            for meters, degrees in METRIC
        ),
        median_position=float(np.median(centers)),
        confident_wrong=int(np.sum((outcomes.confidence > 0.9) & (outcomes.error >= FRACTIONS[0]))),
        queries=len(queries),
    )


HEADER = (
    "| scene | way | query ms | mean | extract | match | pose | per second from file "
    "| right at 0.1, 0.05, 0.02 d | median error | p90 | 5 cm 5°, 1 cm 1° | wrong over 0.9 |"
)


def _print(row: Row) -> None:
    shares = ", ".join(f"{one:.1f}" for one in row.shares)
    metric = ", ".join(f"{one:.1f}" for one in row.metric)
    print(
        f"| {row.scene} | {row.way} | {row.query_ms:.1f} | {row.mean_ms:.1f} | {row.extract_ms:.1f} "
        f"| {row.match_ms:.1f} | {row.pose_ms:.1f} | {1e3 / (row.decode_ms + row.query_ms):.1f} | {shares} "
        f"| {row.median_error:.5f} | {row.p90_error:.5f} | {metric} | {row.confident_wrong} |",
        flush=True,
    )


def _print_forecast(scene: Scene, rows: list[Row], output: Path) -> None:
    forecast = measure_speed(scene.references, _slim(scene, output))
    found = [row.query_ms for row in rows if row.way == "slim, rounds"]
    if forecast and found:
        predicted = 1e3 * forecast.slim.total
        print(
            f"{scene.name}: forecast {predicted:.1f} ms, {predicted / found[0]:.2f} times what was measured"
        )


def _summarize(rows: list[Row]) -> None:
    """How many times faster rounds are, per map, and what they cost."""
    for map_ in ("slim", "full"):
        pairs = [
            (one, other)
            for one in rows
            for other in rows
            if (one.way, other.way) == (f"{map_}, whole", f"{map_}, rounds") and one.scene == other.scene
        ]
        for one, other in pairs:
            lost = ", ".join(f"{a - b:.1f}" for a, b in zip(one.shares, other.shares, strict=True))
            print(
                f"{one.scene}, {map_}: {one.query_ms / other.query_ms:.2f}x faster "
                f"({one.mean_ms / other.mean_ms:.2f}x on average), points lost {lost}, "
                f"median error {other.median_error / one.median_error:.2f}x"
            )
        if pairs:
            mean = geometric_mean(one.query_ms / other.query_ms for one, other in pairs)
            print(f"{map_}: {mean:.2f}x faster, geometric mean of {len(pairs)} scenes")


if __name__ == "__main__":
    main()
