"""Measure how time and memory of the reference graph grow with the number of images.

    python benchmarks/graph_growth.py -o /tmp/growth --images 50 100 200 500 1000 2000 5000 10000

For each size, writes a map of a walk through a city. A separate process reads it and computes the graph from
the stored matches, on one core. Prints the table and the exponent of time over covisible pairs.
"""

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from city import CityOptions, city_map
from slimsfm.files import remove
from slimsfm.graph import GraphOptions, compute_graph
from slimsfm.mapping import read_map, write_map


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--images", nargs="+", type=int, default=[50, 100, 200, 500, 1000, 2000, 5000, 10000])
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measure(arguments.measure)))
        return
    rows = [row_of(count, arguments.output) for count in arguments.images]
    large = [row for row in rows if row["images"] >= 200]
    if len(large) >= 2:
        logs = np.log([(row["pairs"], row["localize_s"]) for row in large])
        exponent = np.polyfit(logs[:, 0], logs[:, 1], 1)[0]
        print(f"time grows with covisible pairs to the power {exponent:.3f} (target at most 1.15)")


def row_of(count: int, output: Path) -> dict:
    """Make a city, measure in another process, print the row."""
    path = output / f"city-{count}"
    if not path.exists():
        write_map(city_map(CityOptions(images=count)), path)
    command = [sys.executable, __file__, "-o", str(output), "--measure", str(path)]
    row = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    print("  ".join(f"{name} {value:g}" for name, value in row.items()), flush=True)
    remove(path)
    return row


def measure(path: Path) -> dict:
    """Read a map and compute its graph in this process."""
    start = perf_counter()
    map_ = read_map(path)
    read = perf_counter() - start
    run = compute_graph(map_, GraphOptions(edges="matches"))
    return {
        "images": len(map_.images),
        "pairs": run.pairs_tried,
        "edges": run.graph.num_edges(),
        "read_s": round(read, 2),
        **{f"{stage}_s": round(seconds, 2) for stage, seconds in run.seconds.items()},
        "ms_per_pair": round(1e3 * run.seconds["localize"] / max(run.pairs_tried, 1), 3),
        "peak_GiB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3),
    }


if __name__ == "__main__":
    main()
