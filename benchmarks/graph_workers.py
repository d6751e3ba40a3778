"""Compare one Dask worker with two, for localizing every image of a map from every other.

    python benchmarks/graph_workers.py MAP

The time includes starting and closing the cluster; the two graphs must be equal bit by bit.
"""

import argparse
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np

from slimsfm.execution import dask_cluster
from slimsfm.graph import GraphOptions, GraphRun, GraphWork, compute_graph
from slimsfm.mapping import read_map


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map", type=Path)
    path = parser.parse_args().map
    times, runs = {}, {}
    for workers in (1, 2):
        start = perf_counter()
        runs[workers] = with_workers(path, workers)
        times[workers] = perf_counter() - start
        print(
            f"{workers} Dask workers: {times[workers]:.1f} s for {runs[workers].pairs_tried} pairs",
            flush=True,
        )
    equal = np.array_equal(runs[1].graph.dense(), runs[2].graph.dense())
    print(f"two are {times[1] / times[2]:.2f} times as fast as one (target 1.6); graphs equal: {equal}")


def with_workers(path: Path, workers: int) -> GraphRun:
    """Compute the graph on a local cluster."""
    work = GraphWork(map_path=path, open_executor=partial(dask_cluster, None, workers))
    return compute_graph(read_map(path), GraphOptions(edges="localize", candidates="all"), work)


if __name__ == "__main__":
    main()
