"""Learn the weights of the confidence of a pose, and measure how well the confidence agrees with the truth.

    python benchmarks/confidence.py PHOTOS [PHOTOS ...] -o /tmp/scenes

Every strategy localizes every query of every scene, with all keypoints and with random subsets of them, and
also queries of another scene, whose poses are all wrong. Each round of each strategy gives one example. The
final weights are learned from all scenes. The reliability of a scene uses weights learned from all other
scenes.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from benchmark_scenes import Scene, scenes
from deceptive_scenes import deceptions
from slimsfm.evaluation.results import PreparedQuery
from slimsfm.geometry import ADD_FRACTIONS, corner_error
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.point_descriptors import describe_points
from slimsfm.localization.strategy import MatchingOptions
from slimsfm.mapping.subset import direct_map
from slimsfm.synthetic.objects import OBJECTS

KEPT = (1.0, 0.25, 0.08)  # shares of the keypoints of a query
SLIM = 400  # points of a reduced map, drawn at random
EDGES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.99, 1.0)


@dataclass(frozen=True, kw_only=True)
class Example:
    """One pose."""

    scene: str
    kind: str
    terms: np.ndarray
    right: bool


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--objects", nargs="*", default=sorted(OBJECTS))
    arguments = parser.parse_args()
    known = list(scenes(arguments.folders, arguments.objects, arguments.output))
    known += list(deceptions(arguments.output))
    examples = []
    for scene, other in zip(known, [*known[1:], known[0]], strict=True):
        found = list(examples_of(scene, other))
        examples += found
        print(
            f"{scene.name}: {len(found)} poses, {np.mean([one.right for one in found]):.0%} right", flush=True
        )
    np.savez(
        arguments.output / "confidence.npz",
        terms=[one.terms for one in examples],
        right=[one.right for one in examples],
        scene=[one.scene for one in examples],
        kind=[one.kind for one in examples],
    )
    report(examples)


def examples_of(scene: Scene, other: Scene) -> Iterator[Example]:
    """The poses of all rounds of all strategies."""
    full = scene.references
    described = describe_points(full)
    drawn = np.sort(np.random.default_rng(0).permutation(len(described.points))[:SLIM])
    makers = {
        "progressive": (full, LocalizationOptions(strategy="progressive")),
        "retrieval": (full, LocalizationOptions(strategy="retrieval", matching=MatchingOptions(retrieved=3))),
        "direct": (full, LocalizationOptions(strategy="direct")),
        "slim": (direct_map(full, described[drawn]), LocalizationOptions(strategy="direct")),
    }
    for kind, (map_, options) in makers.items():
        localizer = Localizer(map_, options)
        for number, prepared in enumerate(scene.queries):
            share = KEPT[number % len(KEPT)] if kind in ("progressive", "direct") else 1.0
            yield from poses(scene, kind, localizer, thinned(prepared, share), strange=False)
            if share < 1 and number % 2:
                yield from poses(scene, kind, localizer, prepared, strange=False)
        for prepared in other.queries[::4]:
            yield from poses(scene, f"{kind}, other scene", localizer, prepared, strange=True)


def thinned(prepared: PreparedQuery, share: float) -> PreparedQuery:
    """The query with a random subset of its keypoints."""
    count = len(prepared.features)
    kept = np.sort(np.random.default_rng(count).permutation(count)[: max(1, round(share * count))])
    return replace(prepared, features=prepared.features[kept])


def poses(
    scene: Scene, kind: str, localizer: Localizer, prepared: PreparedQuery, *, strange: bool
) -> Iterator[Example]:
    """The poses of all rounds."""
    for attempt in localizer.rounds(prepared.features, prepared.query.camera):
        if attempt.pose is None or attempt.evidence is None:
            continue
        truth = prepared.query.cam_from_world
        error = corner_error(attempt.pose.cam_from_world, truth, scene.references.box)
        yield Example(
            scene=scene.name,
            kind=kind,
            terms=attempt.evidence.terms,
            right=not strange and error < ADD_FRACTIONS[0],
        )


def learn(examples: Sequence[Example]) -> np.ndarray:
    """Logistic regression with equal weights for all scenes; only the constant may be negative."""
    terms = np.array([one.terms for one in examples])
    signs = np.array([1.0 if one.right else -1.0 for one in examples])
    names = [one.scene for one in examples]
    weights = np.array([1 / names.count(one) for one in names])

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        margins = signs * (terms @ values)
        slopes = -signs * weights / (1 + np.exp(np.clip(margins, -50, 50)))
        shrink = 1e-3 * values[1:]
        value = weights @ np.logaddexp(0, -margins) + shrink @ values[1:] / 2
        return value, terms.T @ slopes + np.concatenate([[0.0], shrink])

    bounds = [(None, None), *[(0.0, None)] * (terms.shape[1] - 1)]
    return minimize(loss, np.zeros(terms.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B").x


def report(examples: list[Example]) -> None:
    """Print reliability by confidence, and the weights."""
    probabilities = np.empty(len(examples))
    scene_of = np.array([one.scene for one in examples])
    right = np.array([one.right for one in examples])
    terms = np.array([one.terms for one in examples])
    for name in dict.fromkeys(scene_of):
        weights = learn([one for one in examples if one.scene != name])
        here = scene_of == name
        probabilities[here] = 1 / (1 + np.exp(-np.clip(terms[here] @ weights, -50, 50)))
        sure = here & (probabilities > 0.9)
        print(
            f"{name:16} over 0.9: {sure.sum():5d} of {here.sum():5d}, "
            f"wrong {100 * np.mean(~right[sure]):5.2f} %; "
            f"right below 0.5: {100 * np.mean(probabilities[here & right] < 0.5):.1f} %"
        )
    print("confidence   poses   mean   right")
    for low, high in pairwise(EDGES):
        rows = (probabilities >= low) & (probabilities <= high if high == 1 else probabilities < high)
        if rows.any():
            print(
                f"{low:.2f} to {high:.2f} {rows.sum():6d}  {probabilities[rows].mean():.3f}  "
                f"{right[rows].mean():.3f}"
            )
    print("weights", np.round(learn(examples), 2).tolist())


if __name__ == "__main__":
    main()
