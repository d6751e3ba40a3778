"""Compare sources of edges with localizing every image from every other: time, decisions, consequences.

    python benchmarks/edge_sources.py PHOTOS [PHOTOS ...] -o /tmp/edge-sources

Each folder of photos is reconstructed once, with every third photo held out. Results of `slimsfm benchmark
images` in the same output folder are reused. Two rendered objects are added. All sources run in this process
on one thread, one after the other.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmark_scenes import Scene, scenes
from slimsfm.domination import DominationProblem, exact
from slimsfm.evaluation.results import evaluate
from slimsfm.evaluation.scores import add_percent
from slimsfm.graph import GraphOptions, GraphRun, compute_graph
from slimsfm.graph.edge_sources import all_pairs, likely_pairs
from slimsfm.mapping import Map, keep_images
from slimsfm.progress import shown

THRESHOLD = 0.05
RENDERED = ("printed_box", "boulder")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("-o", "--output", required=True, type=Path)
    arguments = parser.parse_args()
    for scene in scenes(arguments.folders, RENDERED, arguments.output):
        compare(scene)


def compare(scene: Scene) -> None:
    """Compute the graph with each source and compare it with the paper's."""
    everything = GraphOptions(edges="localize", candidates="all")
    runs = {"localize": compute_graph(scene.references, everything, progress=shown)}
    for edges in ("matches", "tracks", "hybrid"):
        runs[edges] = compute_graph(scene.references, GraphOptions(edges=edges), progress=shown)
    for edges, one in runs.items():
        print(f"{scene.name}, {edges}: {describe(scene, one, runs['localize'])}")
    print(f"{scene.name}, candidates: {pruning(scene.references, runs['localize'])}")


def describe(scene: Scene, one: GraphRun, paper: GraphRun) -> str:
    """Time, decisions and scores of the dominating set."""
    ours, theirs = (run.graph.dense() < THRESHOLD for run in (one, paper))
    off = ~np.eye(len(ours), dtype=bool)
    too_many = (ours & ~theirs & off).sum() / max((ours & off).sum(), 1)
    chosen = exact(DominationProblem(one.graph.adjacency(THRESHOLD))).chosen
    slim = keep_images(scene.references, [one.graph.names[i] for i in chosen])
    errors = evaluate(slim, scene.queries, "exhaustive").error
    return (
        f"{seconds(one):.2f} s, {seconds(paper) / seconds(one):.1f} times faster than localize; "
        f"{100 * (ours == theirs)[off].mean():.2f} % of decisions equal, {100 * too_many:.2f} % of edges "
        f"too many; "
        f"dominating set {len(chosen)}, ADD-0.1d {add_percent(errors, 0.1):.1f} %"
    )


def seconds(one: GraphRun) -> float:
    """Total over all stages."""
    return sum(one.seconds.values())


def pruning(map_: Map, paper: GraphRun) -> str:
    """Effect of trying only likely pairs."""
    likely, everything = likely_pairs(map_), all_pairs(map_)
    edges = paper.graph.dense() < THRESHOLD
    kept = sum(int(edges[u, v]) + int(edges[v, u]) for u, v in likely)
    share = 100 * kept / max(paper.graph.num_edges(THRESHOLD), 1)
    return f"{len(likely)} of {len(everything)} pairs tried, {share:.2f} % of edges kept (target 99.5)"


if __name__ == "__main__":
    main()
