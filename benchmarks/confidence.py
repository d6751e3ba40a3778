"""Learn the weights of the confidence of a pose, and measure how well the confidence agrees with the truth.

    python benchmarks/confidence.py -o /tmp/disturbed --photos ../shared/data
    python benchmarks/confidence.py -o /tmp/disturbed --photos ../shared/data --extractor xfeat --weights W

The queries of every scene are disturbed in every way of `disturbances.py`, and queries of another scene,
whose poses are all wrong, come as well. They are localized as a user would, in the full map by
`progressive`, and in the reduced map by `direct`; each pose is an example. The final weights are learned from
all scenes. Reliability is printed with the weights that the extractor has, and with weights learned from all
scenes but the one that is tested. Ends with how far the errors lie under their 95 % bounds, by the number of
intrinsics that were estimated.

What was measured of a scene is stored in the output folder, and read from there the next time.
"""

import argparse
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from disturbed_examples import DisturbedQuery, examples
from disturbed_scenes import NAMES, MappedScene, mapped_scene
from slimsfm.geometry import ADD_FRACTIONS, corner_error
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.calibration import EVIDENCE_WEIGHTS, evidence_weights
from slimsfm.localization.cameras import query_camera
from slimsfm.progress import shown
from slimsfm.weights import Runtime, use_runtime

EXPECTED = np.array([3.3, 0.95, 0.6, 0.55, 1.2, 1.05, 1.1, 0.4, 1.5, 3.0, 0.3])
NEARNESS = 0.2
"""Weights that are kept unless the examples speak against them, and how much they count. The first seven were
learned from scenes that deceive and from queries with a twelfth of their keypoints, which tell more about
rivals and few inliers than disturbed queries do. For other extractors than SIFT, SIFT's weights are kept."""

WRONG = 1.35
"""Weight of a wrong pose: to believe one costs more than to doubt a right one."""

EDGES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.99, 1.0)


class Example(NamedTuple):
    """One pose."""

    scene: str
    method: str
    group: str
    terms: np.ndarray
    limit: float
    error: float
    bound: float
    num_estimated: int

    @property
    def is_right(self) -> bool:
        """Whether the pose is right."""
        return self.error < ADD_FRACTIONS[0]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--photos", required=True, type=Path, help="folder with plush, fox, lund and office")
    parser.add_argument("--scenes", nargs="+", default=NAMES, choices=NAMES)
    parser.add_argument("--every", type=int, default=2, help="2: every second disturbed query")
    parser.add_argument("--extractor", default="sift", help="of maps and queries")
    parser.add_argument("--weights", type=Path, help="folder with the weights of the extractor")
    arguments = parser.parse_args()
    use_runtime(Runtime(weights=arguments.weights, device="cpu"))
    scenes = [
        mapped_scene(name, arguments.photos, arguments.output, arguments.extractor)
        for name in arguments.scenes
    ]
    found: list[Example] = []
    for scene in scenes:
        path = scene.folder / "confidence.npz"
        if not path.exists():
            write_examples(path, list(examples_of(scene, scenes, arguments.every)))
        found += read_examples(path)
    report(found, arguments.extractor)


def examples_of(scene: MappedScene, scenes: Sequence[MappedScene], every: int) -> Iterator[Example]:
    """The poses of all queries with all methods."""
    methods = {
        "progressive, full": (scene.full, LocalizationOptions(strategy="progressive")),
        "direct, slim": (scene.slim, LocalizationOptions(strategy="direct")),
    }
    queries = list(examples(scene, scenes, every=every))
    for method, (map_, options) in methods.items():
        localizer = Localizer(map_, options)
        for query in shown(queries, f"{scene.name} ({method})"):
            yield from example_of(scene, method, localizer, query)


def example_of(
    scene: MappedScene, method: str, localizer: Localizer, query: DisturbedQuery
) -> Iterator[Example]:
    """The pose of a query, if there is one."""
    camera = query_camera(localizer.map, query.path, query.believed)
    result = localizer.search(query.features, camera).best
    if result.pose is None or result.evidence is None or result.evidence.is_behind:
        return  # a pose behind the surface is not believed whatever its other evidence
    error = np.inf
    if query.cam_from_world is not None:
        error = corner_error(result.pose.cam_from_world, query.cam_from_world, scene.full.box)
    yield Example(
        scene=scene.name,
        method=method,
        group=query.disturbance,
        terms=result.evidence.terms,
        limit=result.evidence.limit,
        error=error,
        bound=result.pose.corner_bound(scene.full.box),
        num_estimated=len(result.pose.estimated),
    )


def write_examples(path: Path, found: Sequence[Example]) -> None:
    """Store the examples of a scene."""
    np.savez(path, **{name: [getattr(one, name) for one in found] for name in Example._fields})


def read_examples(path: Path) -> list[Example]:
    """Read what `write_examples` stored."""
    columns = np.load(path)
    return [Example(*row) for row in zip(*(columns[name] for name in Example._fields), strict=True)]


def learn(found: Sequence[Example], expected: np.ndarray) -> np.ndarray:
    """Logistic regression with equal weights for all scenes, near `expected`; only the constant is free."""
    terms = np.array([one.terms for one in found])
    signs = np.array([1.0 if one.is_right else -1.0 for one in found])
    names = [one.scene for one in found]
    weights = np.array([1 / names.count(one) for one in names]) * np.where(signs < 0, WRONG, 1.0)

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        margins = signs * (terms @ values)
        slopes = -signs * weights / (1 + np.exp(np.clip(margins, -50, 50)))
        off = (values - expected)[1:]
        shrink = NEARNESS * off
        value = weights @ np.logaddexp(0, -margins) + shrink @ off / 2
        return value, terms.T @ slopes + np.concatenate([[0.0], shrink])

    bounds = [(None, None), *[(0.0, None)] * (terms.shape[1] - 1)]
    return minimize(loss, expected, jac=True, bounds=bounds, method="L-BFGS-B").x


def confidences_by(weights: np.ndarray, found: Sequence[Example]) -> np.ndarray:
    """The confidence of each example by these weights."""
    log_odds = np.array([one.terms for one in found]) @ weights
    return np.minimum(1 / (1 + np.exp(-np.clip(log_odds, -50, 50))), [one.limit for one in found])


def left_out_confidences(found: Sequence[Example], expected: np.ndarray) -> np.ndarray:
    """The confidence of each example by weights that are learned from the other scenes."""
    confidences = np.empty(len(found))
    scene_of = np.array([one.scene for one in found])
    for name in dict.fromkeys(scene_of):
        weights = learn([one for one in found if one.scene != name], expected)
        here = [one for one in found if one.scene == name]
        confidences[scene_of == name] = confidences_by(weights, here)
    return confidences


def report(found: list[Example], extractor: str) -> None:
    """Print reliability by the present and by learned weights, the bounds, and the weights."""
    expected = EXPECTED if extractor == "sift" else EVIDENCE_WEIGHTS["sift"]
    print(f"confidence of {extractor} as it is")
    print_reliability(found, confidences_by(evidence_weights(extractor), found))
    if len({one.scene for one in found}) > 1:
        print("by weights learned from the other scenes")
        print_reliability(found, left_out_confidences(found, expected))
    print_bounds(found)
    print("weights", np.round(learn(found, expected), 2).tolist())


def print_reliability(found: Sequence[Example], confidences: np.ndarray) -> None:
    """Print reliability by scene, disturbance, method and confidence."""
    right = np.array([one.is_right for one in found])
    for kind in ("scene", "group", "method"):
        print(f"{kind:18} poses   right   mean  over 0.9  wrong  found, right  error of calibration")
        values = np.array([getattr(one, kind) for one in found])
        for value in dict.fromkeys(values):
            print(line(value, confidences[values == value], right[values == value]))
    print(line("all", confidences, right))
    print("confidence   poses   mean   right")
    for low, high in pairwise(EDGES):
        rows = (confidences >= low) & (confidences <= high if high == 1 else confidences < high)
        if rows.any():
            print(
                f"{low:.2f} to {high:.2f} {rows.sum():6d}  {confidences[rows].mean():.3f}  "
                f"{right[rows].mean():.3f}"
            )


def line(name: str, confidences: np.ndarray, right: np.ndarray) -> str:
    """One row of a table of reliability."""
    sure = confidences > 0.9
    return (
        f"{name:18} {len(right):5d}  {right.mean():6.3f} {confidences.mean():6.3f}  {sure.sum():8d} "
        f"{np.sum(~right[sure]):6d}  {np.sum(right & (confidences >= 0.5)):12d}  "
        f"{calibration_error(confidences, right):8.3f}"
    )


def calibration_error(confidences: np.ndarray, right: np.ndarray) -> float:
    """Expected calibration error with ten bins."""
    bins = np.minimum((10 * confidences).astype(int), 9)
    parts = [bins == one for one in range(10)]
    return sum(
        part.mean() * abs(confidences[part].mean() - right[part].mean()) for part in parts if part.any()
    )


def print_bounds(found: Sequence[Example]) -> None:
    """Print how many errors of right poses lie under their bounds."""
    print("scene, method, estimated intrinsics: right poses, median and 95th percentile of error over bound")
    kept = [one for one in found if one.is_right]
    keys = sorted({(one.scene, one.method, int(one.num_estimated)) for one in kept})
    for key in keys:
        ratios = [one.error / one.bound for one in kept if (one.scene, one.method, one.num_estimated) == key]
        print(
            *key,
            len(ratios),
            *np.quantile(ratios, (0.5, 0.95)).round(2),
            f"{np.mean(np.less(ratios, 1)):.0%}",
        )


if __name__ == "__main__":
    main()
