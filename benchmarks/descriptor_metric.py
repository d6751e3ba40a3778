"""How descriptors of right and wrong matches differ on photos, to choose an extractor's `NearestOptions`.

    python benchmarks/descriptor_metric.py xfeat PHOTOS [PHOTOS ...] --weights WEIGHTS

In each folder of photos, some pairs of photos two names apart are matched: mutual nearest descriptors without
any threshold. Matches that fit the epipolar geometry of the pair count as right. Printed are the shares of
right and of wrong matches below thresholds of two values: the angle between the descriptors, and its ratio to
the angle to the second nearest.
"""

import argparse
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.features import Features, load_extractor, unit_rows
from slimsfm.image_files import list_images
from slimsfm.photos import read_image
from slimsfm.weights import Runtime, use_runtime

RATIOS = (0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0)
ANGLES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2)
MAX_ERROR_PX = 2.0


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("extractor")
    parser.add_argument("photos", nargs="+", type=Path)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--pairs", type=int, default=8, help="per folder")
    arguments = parser.parse_args()
    use_runtime(Runtime(weights=arguments.weights, device="cpu"))
    found = []
    for folder in arguments.photos:
        table = np.concatenate(scene_matches(folder, arguments.extractor, arguments.pairs))
        right = table[:, 2] > 0
        print(f"{folder.name}: {right.sum()} right matches, {(~right).sum()} wrong ones")
        found.append(table)
    show(np.concatenate(found))


def scene_matches(folder: Path, extractor: str, count: int) -> list[np.ndarray]:
    """Matches of pairs that are spread over a folder: angle, ratio, and whether a match is right."""
    names = list_images(folder)
    starts = np.linspace(0, len(names) - 3, count).astype(int)
    made, matches = load_extractor(extractor), []
    for start in starts:
        features = [made.extract(read_image(folder / names[i])) for i in (start, start + 2)]
        matches.append(pair_matches(*features))
    return matches


def pair_matches(one: Features, other: Features) -> np.ndarray:
    """Mutual nearest neighbors of two images, a row each: angle, ratio, and whether they fit the pair."""
    cosines = unit_rows(one.descriptors) @ unit_rows(other.descriptors).T
    nearest = cosines.argmax(axis=1)
    rows = np.flatnonzero(cosines.argmax(axis=0)[nearest] == np.arange(len(one)))
    columns = nearest[rows]
    angles = np.arccos(np.clip(-np.partition(-cosines[rows], 1)[:, :2], -1, 1))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error = MAX_ERROR_PX
    geometry = pycolmap.estimate_two_view_geometry(
        simple_camera(one),
        one.keypoints[rows].astype(float),
        simple_camera(other),
        other.keypoints[columns].astype(float),
        np.stack([np.arange(len(rows))] * 2, axis=1).astype(np.uint32),
        options,
    )
    right = np.zeros(len(rows))
    right[np.asarray(geometry.inlier_matches)[:, 0]] = 1
    return np.stack([angles[:, 0], angles[:, 0] / np.maximum(angles[:, 1], 1e-9), right], axis=1)


def simple_camera(features: Features) -> pycolmap.Camera:
    """A camera with a usual focal length, as a photo without EXIF gets it."""
    width, height = features.image_size
    return pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=width,
        height=height,
        params=[1.2 * max(width, height), width / 2, height / 2, 0],
    )


def show(table: np.ndarray) -> None:
    """Print the shares of right and wrong matches below thresholds, and percentiles of the right ones."""
    right = table[:, 2] > 0
    for column, (title, thresholds) in enumerate((("angle", ANGLES), ("ratio", RATIOS))):
        values = table[:, column]
        print(f"\n{title:>8}   right   wrong")
        for low in thresholds:
            shares = (100 * np.mean(values[chosen] <= low) for chosen in (right, ~right))
            print(f"{low:8.2f}" + "".join(f"{share:7.1f}%" for share in shares))
        quantiles = np.percentile(values[right], [50, 90, 95, 99])
        print("right at 50, 90, 95, 99 %: " + ", ".join(f"{value:.2f}" for value in quantiles))


if __name__ == "__main__":
    main()
