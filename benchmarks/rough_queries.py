"""What blur, darkness and occlusion do to queries, and how many a reduced map loses by them.

    python benchmarks/rough_queries.py PHOTOS [PHOTOS ...] -o /tmp/scenes

Every third photo of a folder is a query; each is localized as it is and disturbed. Printed are, per
disturbance, the share of right matches that remain and how far their keypoints move, by the size of the
keypoint relative to the blur: `slimsfm.reduction.disturbance` has its parameters from there. Then the share
of right poses with the full map, matched exhaustively, and with what `reduce` gives, with and without the
reserve for rough queries.
"""

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
from scipy.spatial import KDTree

from benchmark_scenes import Scene, scenes
from slimsfm.arrays import Image, evenly_spaced
from slimsfm.evaluation.results import PreparedQuery
from slimsfm.features import Features, load_extractor, unit_rows
from slimsfm.geometry import corner_error, reprojection_errors
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.matching import match_target
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.localization.strategy import Target
from slimsfm.mapping import Map
from slimsfm.mapping.io import weigh_map
from slimsfm.photos import read_image
from slimsfm.reduction import ReduceOptions, reduce

RIGHT = 0.1  # of the diagonal: largest corner error of a right pose
RIGHT_PX = 4.0  # largest reprojection error of a right match
SAME_PX = 4.0  # largest distance of a keypoint before and after
SIZES = (0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, np.inf)  # scales of keypoints, in pixels
Disturbed = Callable[[Image, Image, np.random.Generator], Image]


def clean(image: Image, _: Image, __: np.random.Generator) -> Image:
    """The photo as it is."""
    return image


def blurred(sigma: float) -> Disturbed:
    """Blurred by a Gaussian of this sigma, in pixels."""
    return lambda image, _, __: np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)


def night(image: Image, _: Image, rng: np.random.Generator) -> Image:
    """A tenth of the light, with shot noise of 400 electrons at white and read noise of 3, brightened."""
    linear = 0.1 * (image / 255.0) ** 2.2
    electrons = rng.poisson(400 * linear) + rng.normal(0, 3, image.shape)
    return np.clip(255 * np.clip(electrons / 100, 0, 1) ** (1 / 2.2), 0, 255).astype(np.uint8)


def hidden(share: float) -> Disturbed:
    """A photo of another place hides a side of the image, at a random angle."""

    def disturb(image: Image, other: Image, rng: np.random.Generator) -> Image:
        height, width = image.shape[:2]
        angle = rng.uniform(0, 2 * np.pi)
        rows, columns = np.mgrid[:height, :width]
        along = columns * np.cos(angle) + rows * np.sin(angle)
        covering = np.asarray(cv2.resize(other, (width, height)), np.uint8)
        return np.where((along < np.quantile(along, share))[..., None], covering, image)

    return disturb


DISTURBANCES: dict[str, Disturbed] = {
    "clean": clean,
    "blur 1.5 px": blurred(1.5),
    "blur 3 px": blurred(3.0),
    "night": night,
    "hidden 40 %": hidden(0.4),
    "hidden 60 %": hidden(0.6),
}


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A query before and after."""

    query: PreparedQuery
    before: Features
    after: Features


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--queries", type=int, default=20, help="largest number of queries per scene")
    parser.add_argument("--only", choices=("matches", "poses"), help="print one part only")
    arguments = parser.parse_args()
    known = list(scenes(arguments.folders, (), arguments.output))
    for scene, other in zip(known, [*known[1:], known[0]], strict=True):
        pairs = {name: list(disturb(scene, other, name, arguments.queries)) for name in DISTURBANCES}
        print(f"\n{scene.name}: {len(scene.references.images)} references, {len(pairs['clean'])} queries")
        if arguments.only != "poses":
            print_matches(scene.references, pairs)
        if arguments.only != "matches":
            print_poses(scene, pairs)


def disturb(scene: Scene, other: Scene, name: str, most: int) -> Iterator[Pair]:
    """Disturb queries of a scene; those of another one hide things."""
    extractor = load_extractor(scene.references.info.extractor, scene.references.info.extractor_options)
    places = evenly_spaced(len(scene.queries), most)
    for number, place in enumerate(places.tolist()):
        query = scene.queries[place]
        image = read_image(query.query.path, query.query.orientation)
        covering = read_image(other.queries[number % len(other.queries)].query.path)
        disturbed = DISTURBANCES[name](image, covering, np.random.default_rng(number))
        yield Pair(query=query, before=query.features, after=extractor.extract(disturbed))


def print_matches(references: Map, pairs: dict[str, list[Pair]]) -> None:
    """What remains of the right matches with the points of the map, and how many wrong ones there are."""
    described = describe_points(references)
    target = described.descriptors, described.points
    for name, some in pairs.items():
        by_size = defaultdict(list)
        moved, turned, wrong = [], [], np.zeros(2)
        for pair in some:
            if pair.before.frames is None:
                raise SystemExit("the keypoints have no scales; use maps of SIFT")
            was, now = (Matched.of(references, one, pair, target) for one in (pair.before, pair.after))
            wrong += was.wrong, now.wrong
            turned += turns(pair, was)
            for keypoint, point in was.point_of.items():
                kept = point in now.pixel_of
                by_size[int(np.digitize(pair.before.frames[keypoint, 0], SIZES))].append(kept)
                if kept:
                    moved.append(np.subtract(now.pixel_of[point], was.pixel_of[point]))
        sizes = ", ".join(f"{SIZES[one - 1]:g}: {np.mean(kept):.2f}" for one, kept in sorted(by_size.items()))
        share = np.mean([kept for some_kept in by_size.values() for kept in some_kept])
        print(
            f"{name:12} right matches kept {share:.2f}, moved {1.48 * np.median(np.abs(moved)):.2f} px, "
            f"descriptors turned {np.median(turned):.0f} deg, wrong matches x{wrong[1] / wrong[0]:.2f}; "
            f"kept by scale from ... px: {sizes}",
            flush=True,
        )


@dataclass(frozen=True, kw_only=True)
class Matched:
    """The right matches of features with all points of a map, and the number of wrong ones."""

    point_of: dict[int, int]
    pixel_of: dict[int, np.ndarray]
    wrong: int

    @classmethod
    def of(cls, references: Map, features: Features, pair: Pair, target: Target) -> "Matched":
        """Match, and tell right from wrong by the true pose."""
        found = match_target(unit_rows(features.descriptors), target, references.descriptor_metric)
        query = pair.query.query
        pixels = features.keypoints[found.keypoints].astype(np.float64)
        points3D = references.points3D_in_world[found.points]
        right = reprojection_errors(pixels, points3D, query.cam_from_world, query.camera) <= RIGHT_PX
        points = found.points[right].tolist()
        return cls(
            point_of=dict(zip(found.keypoints[right].tolist(), points, strict=True)),
            pixel_of=dict(zip(points, pixels[right], strict=True)),
            wrong=int(np.sum(~right)),
        )


def turns(pair: Pair, was: Matched) -> list[float]:
    """Angles in degrees between descriptors that match and those that are found there afterwards."""
    rows = np.array(list(was.point_of), np.int64)
    if not len(rows) or not len(pair.after):
        return []
    distances, places = KDTree(pair.after.keypoints).query(pair.before.keypoints[rows], k=3)
    before = unit_rows(pair.before.descriptors)[rows[:, None]]
    after = unit_rows(pair.after.descriptors)[places]
    cosines = np.where(distances <= SAME_PX, (before * after).sum(axis=2), -1).max(axis=1)
    return np.degrees(np.arccos(np.clip(cosines[cosines > -1], -1, 1))).tolist()


def print_poses(scene: Scene, pairs: dict[str, list[Pair]]) -> None:
    """The share of right poses with the full map and with reduced ones."""
    maps = {"full": scene.references}
    for conditions in ("clean", "rough"):
        start = perf_counter()
        reduced = reduce(scene.references, ReduceOptions(conditions=conditions))
        seconds = perf_counter() - start
        maps[conditions], size = reduced.map, weigh_map(reduced.map)
        one = reduced.forecast["direct"]
        print(
            f"reduced for {conditions} queries: {one.choice.method}, {len(reduced.map.point3D_ids)} points, "
            f"{size / 1000:.0f} kB, {scene.bytes / size:.0f}x smaller, in {seconds:.1f} s; "
            f"predicted loss {one.loss:.1f}"
            f"{'' if one.rough_loss is None else f', rough {one.rough_loss:.1f}'}",
            flush=True,
        )
    for name, some in pairs.items():
        shares = {key: share_right(made, some, key == "full") for key, made in maps.items()}
        print(
            f"{name:12} right: " + ", ".join(f"{key} {share:5.1f}" for key, share in shares.items()),
            flush=True,
        )


def share_right(made: Map, pairs: list[Pair], exhaustive: bool) -> float:
    """Percentage of queries that are localized with a right pose."""
    options = LocalizationOptions()
    localizer = Localizer(made, replace(options, strategy="exhaustive") if exhaustive else options)
    right = []
    for pair in pairs:
        query = pair.query.query
        pose = localizer.localize_features(pair.after, query.camera).pose
        right.append(
            pose is not None and corner_error(pose.cam_from_world, query.cam_from_world, made.box) < RIGHT
        )
    return 100 * float(np.mean(right))


if __name__ == "__main__":
    main()
