"""From image file to pose: queries per second on all cores, and the effect of detector settings.

    python benchmarks/throughput.py -o /tmp/plane

Uses the rendered objects and the reduced maps of `plane.py` in the output folder. Each setting localizes the
same files on one thread per core; the time includes decoding, extraction, matching, pose estimation and
verification. Only the strongest keypoints are kept, and images are shrunk before extraction.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np

from slimsfm.datasets.onepose import read_object
from slimsfm.evaluation.results import PosedQuery, queries_of
from slimsfm.execution import map_on_threads, num_cores
from slimsfm.geometry import corner_error
from slimsfm.localization import Localization, Localizer
from slimsfm.mapping import read_map
from slimsfm.photos import read_image

SETTINGS = tuple((features, size) for size in (1600, 480, 320) for features in (4096, 2048, 1024, 512))


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--objects", nargs="*", default=["can", "printed_box", "boulder"])
    arguments = parser.parse_args()
    print("max features, longer side: queries a second, % within 0.1 and 0.02 d (target 8 a second)")
    for features, size in SETTINGS:
        rates, errors = [], []
        for name in arguments.objects:
            rate, found = measure(arguments.output, name, features, size)
            rates.append(rate)
            errors += found
        shares = [100 * np.mean(np.array(errors) < fraction) for fraction in (0.1, 0.02)]
        print(
            f"{features:5d} {size:5d}: {np.mean(rates):6.1f}  {shares[0]:5.1f} {shares[1]:5.1f}", flush=True
        )


def measure(output: Path, name: str, features: int, size: int) -> tuple[float, list[float]]:
    """Queries per second, and the error of each query."""
    map_ = read_map(output / "reduced" / f"{name}-points")
    options = {**map_.info.extractor_options, "max_features": features, "max_image_size": size}
    localizer = Localizer(replace(map_, info=replace(map_.info, extractor_options=options)))
    queries = queries_of(read_object(output / "objects" / name).query)
    start = perf_counter()
    found = list(map_on_threads(partial(localize, localizer), queries, num_cores()))
    rate = len(queries) / (perf_counter() - start)
    errors = [
        corner_error(one.pose.cam_from_world, query.cam_from_world, map_.box) if one.pose else np.inf
        for one, query in zip(found, queries, strict=True)
    ]
    return rate, errors


def localize(localizer: Localizer, query: PosedQuery) -> Localization:
    """From file to pose."""
    return localizer.localize(read_image(query.path, query.orientation), query.camera)


if __name__ == "__main__":
    main()
