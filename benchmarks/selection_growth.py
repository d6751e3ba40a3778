"""Measure how time and memory of choosing points grow with the map.

    python benchmarks/selection_growth.py --points 10000 100000 1000000

For each size, makes a walk down a street: an image sees the points near its position, about ten images see
each point, and there are a hundred points per image. A separate process chooses points with each selector;
its peak memory includes the problem. Prints the table, and compares the largest size with the targets.
"""

import argparse
import json
import resource
import subprocess
import sys
from time import perf_counter

import numpy as np
from scipy.sparse import csr_array

from slimsfm.selection import SELECTORS, SelectionProblem

POINTS_AN_IMAGE = 100  # points over images, each seen by ten
REACH = 10.0  # images to either side, the standard deviation of where a point is seen from
FOCAL_PX = 1000.0
DIAGONAL = 20.0  # of the box, in meters
MAX_SECONDS, MAX_GIB = 600, 8


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--points", nargs="+", type=int, default=[10_000, 100_000, 1_000_000])
    parser.add_argument(
        "--selectors", nargs="+", choices=sorted(SELECTORS), default=["information", "kcover"]
    )
    parser.add_argument("--kept", type=float, default=2.5, help="points to choose for each image of the map")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measure(arguments.points[0], arguments.selectors[0], arguments.kept)))
        return
    for selector in arguments.selectors:
        for points in sorted(arguments.points):
            row = row_of(points, selector, arguments.kept)
            print("  ".join(f"{name} {value}" for name, value in row.items()), flush=True)
        met = row["choose_s"] <= MAX_SECONDS and row["peak_GiB"] <= MAX_GIB
        print(
            f"{selector}: {'within' if met else 'NOT within'} {MAX_SECONDS} s and {MAX_GIB} GiB", flush=True
        )


def row_of(points: int, selector: str, kept: float) -> dict:
    """Measure in another process."""
    command = [sys.executable, __file__, "--measure", "--points", str(points), "--selectors", selector]
    command += ["--kept", str(kept)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def measure(points: int, selector: str, kept: float) -> dict:
    """Make a street and choose its points in this process."""
    problem = street(points, max(points // POINTS_AN_IMAGE, 1))
    count = round(kept * problem.num_images)
    start = perf_counter()
    chosen = SELECTORS[selector](problem, count)
    seconds = perf_counter() - start
    seen = problem.usable[:, np.sort(chosen)].sum(axis=1)
    return {
        "selector": selector,
        "points": points,
        "images": problem.num_images,
        "uses": problem.usable.nnz,
        "chosen": len(chosen),
        "fewest_an_image": int(seen.min()),
        "choose_s": round(seconds, 2),
        "peak_GiB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3),
    }


def street(num_points: int, num_images: int, *, seed: int = 0) -> SelectionProblem:
    """Images in a row and the points around them."""
    rng = np.random.default_rng(seed)
    usable = _covisibility(rng, num_points, num_images)
    twists = np.concatenate(
        [_twists(rng, len(block)) for block in np.array_split(usable.indices, -(-usable.nnz // 10**6))]
    )
    return SelectionProblem(usable=usable, twists=twists, corner_twists=_corner_twists(rng, num_images))


def _covisibility(rng: np.random.Generator, num_points: int, num_images: int) -> csr_array:
    times = 2 + rng.poisson(9, num_points)
    points = np.repeat(np.arange(num_points), times)
    places = np.repeat(rng.uniform(0, num_images, num_points), times)
    places += rng.normal(0, REACH, len(places))
    images = np.clip(places.astype(np.int64), 0, num_images - 1)
    images, points = np.divmod(np.unique(images * num_points + points), num_points)
    starts = np.searchsorted(images, np.arange(num_images + 1))
    return csr_array((np.ones(len(points), bool), points, starts), shape=(num_images, num_points))


def _twists(rng: np.random.Generator, count: int) -> np.ndarray:
    """Twists of points in the view of a camera, near and far."""
    z = rng.uniform(3, 30, count)
    x, y = z * rng.uniform(-0.6, 0.6, (2, count))
    zero = np.zeros(count)
    pixels = FOCAL_PX * np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]]).transpose(2, 0, 1)
    return (pixels @ _motions(np.stack([x, y, z], axis=1))).astype(np.float32)


def _corner_twists(rng: np.random.Generator, num_images: int) -> np.ndarray:
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    centers = np.array([0, 0, DIAGONAL]) + rng.normal(0, 2, (num_images, 1, 3))
    corners = (centers + signs * DIAGONAL / np.sqrt(12)).reshape(-1, 3)
    return (_motions(corners) / DIAGONAL).reshape(num_images, 24, 6).astype(np.float32)


def _motions(in_cam: np.ndarray) -> np.ndarray:
    """Motion of points in the camera frame when it turns (radians) and shifts (diagonals)."""
    x, y, z = in_cam.T
    zero = np.zeros(len(in_cam))
    turned = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)
    return np.concatenate([turned, np.tile(DIAGONAL * np.eye(3), (len(in_cam), 1, 1))], axis=2)


if __name__ == "__main__":
    main()
