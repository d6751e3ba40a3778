"""Measure the size of the sets that each solver chooses, its time, and the gap to the proven bound.

    python benchmarks/image_solvers.py
    python benchmarks/image_solvers.py --maps MAP ... graph.npz ... --skip-large

On 80 graphs of views on a sphere, orbits of 200 to 1000 images, two graphs of 10 000 images and any saved
reference graphs: `networkx.dominating_set`, the paper's procedure, and the solvers. Each line ends with the
proven bound; then the targets follow, met or missed. A map is a folder with `graph*.npz` in it. The solver
`cpsat` needs OR-Tools. Times include the effect of other load on this machine.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import networkx as nx
import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from slimsfm.domination import SOLVERS, DominationProblem, Solution, dominates

PAPER = "random"


@dataclass(frozen=True, kw_only=True)
class Row:
    """Results of all methods on one graph."""

    name: str
    problem: DominationProblem
    networkx: int
    solutions: dict[str, Solution]

    @property
    def bound(self) -> float:
        """The best bound of any solver."""
        return max(solution.lower_bound for solution in self.solutions.values())

    def above_bound(self, solver: str) -> float:
        """Percentage by which a solver's set exceeds the best bound."""
        return 100 * (self.solutions[solver].cost / self.bound - 1)

    def line(self) -> str:
        """The row as text."""
        found = [
            f"{name} {solution.cost} ({solution.seconds:.2f} s)" for name, solution in self.solutions.items()
        ]
        edges = self.problem.adjacency.nnz / self.problem.num_nodes - 1
        size = f"{self.name}: {self.problem.num_nodes} nodes, {edges:.1f} edges a node"
        return "  ".join([size, f"networkx {self.networkx}", *found, f"bound {self.bound}"])


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--maps", nargs="*", type=Path, default=[], help="maps or graph files")
    parser.add_argument(
        "--threshold", type=float, default=0.05, help="threshold on the errors of saved graphs"
    )
    parser.add_argument("--skip-large", action="store_true", help="skip the graphs of 10 000 images")
    arguments = parser.parse_args()
    small = [name for name in SOLVERS if name != "cpsat"]
    views = [row_of(f"views {i}", sphere(50 + 50 * i // 79, seed=i), small) for i in range(80)]
    print_views(views)
    limited = {"exact": 30.0, "cpsat": 30.0}
    orbits = [shown(f"orbit {n}", orbit(n), [*SOLVERS], limited) for n in (200, 500, 1000)]
    saved = [shown(name, graph, small) for name, graph in saved_graphs(arguments.maps, arguments.threshold)]
    large = []
    if not arguments.skip_large:
        graphs = {"walk through a city": city_walk(10_000), "scattered views": scattered(10_000)}
        large = [shown(name, graph, [*SOLVERS]) for name, graph in graphs.items()]
    print_targets(views, [*orbits, *saved], large)


def row_of(
    name: str, adjacency: np.ndarray | csr_array, solvers: list[str], limits: dict[str, float] | None = None
) -> Row:
    """Run networkx and some solvers on a graph, and check their results."""
    problem = DominationProblem(adjacency)
    graph = nx.from_scipy_sparse_array(problem.adjacency, create_using=nx.DiGraph)
    theirs = nx.dominating_set(graph, start_with=0)
    solutions = {}
    for solver in solvers:
        options = {"time_limit_s": limits[solver]} if solver in (limits or {}) else {}
        solutions[solver] = SOLVERS[solver](problem, **options)
        if not dominates(adjacency, solutions[solver].chosen):
            raise SystemExit(f"{solver} left {name} undominated")
    return Row(name=name, problem=problem, networkx=len(theirs), solutions=solutions)


def shown(
    name: str, adjacency: np.ndarray | csr_array, solvers: list[str], limits: dict[str, float] | None = None
) -> Row:
    """Make a row and print it immediately."""
    row = row_of(name, adjacency, solvers, limits)
    print(row.line(), flush=True)
    return row


def print_views(rows: list[Row]) -> None:
    """Print the means over the graphs of views."""
    nodes = np.mean([row.problem.num_nodes for row in rows])
    edges = np.mean([row.problem.adjacency.nnz / row.problem.num_nodes - 1 for row in rows])
    print(f"{len(rows)} graphs of views on a sphere: {nodes:.0f} nodes, {edges:.1f} edges a node on average")
    print(f"  networkx {np.mean([row.networkx for row in rows]):.3f} on average")
    for solver in rows[0].solutions:
        costs = np.mean([row.solutions[solver].cost for row in rows])
        slowest = max(row.solutions[solver].seconds for row in rows)
        print(f"  {solver} {costs:.3f} on average, slowest {slowest:.2f} s")
    proven = sum(row.solutions["exact"].is_optimal for row in rows)
    print(f"  proven smallest by exact: {proven} of {len(rows)}", flush=True)


def print_targets(views: list[Row], others: list[Row], large: list[Row]) -> None:
    """Print each target with the measured value."""
    proofs = [row.solutions["exact"] for row in [*views, *others] if row.problem.num_nodes <= 200]
    unproven = sum(not proof.is_optimal for proof in proofs)
    slowest = max(proof.seconds for proof in proofs)
    print_target(
        f"proven minimum up to 200 nodes in 5 s: {unproven} unproven, slowest {slowest:.2f} s",
        unproven == 0 and slowest < 5,
    )
    for row in large:
        for solver, percent, seconds in (("cpsat", 5, 60), ("greedy", 20, 10)):
            above, took = row.above_bound(solver), row.solutions[solver].seconds
            target = f"{row.name}, {solver} within {percent} % of the bound in {seconds} s"
            print_target(f"{target}: {above:.1f} %, {took:.1f} s", above <= percent and took < seconds * 1.02)
    worse = [
        f"{solver} on {row.name}"
        for row in [*views, *others, *large]
        for solver, solution in row.solutions.items()
        if solution.cost > row.solutions[PAPER].cost
    ]
    print_target(f"never worse than the paper's procedure: {len(worse)} times worse {worse}", not worse)


def print_target(text: str, met: bool) -> None:
    """Print one target."""
    print(f"{'met   ' if met else 'MISSED'}  {text}")


def sphere(num_views: int, *, seed: int) -> np.ndarray:
    """Views of an object from above; u localizes v within 50 degrees, with noise of 8 degrees."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num_views, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    return angles_deg(directions) + rng.normal(0, 8, (num_views, num_views)) < 50


def orbit(num_views: int, *, seed: int = 0) -> np.ndarray:
    """A video around an object, up and down, 200 frames per turn; an image localizes within 20 degrees."""
    rng = np.random.default_rng(seed)
    time = np.arange(num_views) / num_views
    yaw = 2 * np.pi * max(1, num_views // 200) * time
    elevation = np.radians(20 + 35 * np.sin(2 * np.pi * 1.7 * time))
    across = np.cos(elevation)
    directions = np.stack([np.cos(yaw) * across, np.sin(yaw) * across, np.sin(elevation)], axis=1)
    return angles_deg(directions) + rng.normal(0, 5, (num_views, num_views)) < 20


def angles_deg(directions: np.ndarray) -> np.ndarray:
    """Angles between all pairs of directions."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.degrees(np.arccos(np.clip(unit @ unit.T, -1, 1)))


def city_walk(num_views: int, *, seed: int = 0) -> csr_array:
    """A long video: a camera walks the streets of a grid, looks ahead, and passes many of them again."""
    rng = np.random.default_rng(seed)
    ways = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    corner, way = np.array([10, 10]), 0
    places, headings_deg = [], []
    while len(places) < num_views:
        if rng.random() < 0.4:
            way = (way + rng.choice([-1, 1])) % 4
        if np.any((corner + ways[way] < 0) | (corner + ways[way] > 20)):
            way = (way + 2) % 4
        for step in range(1, 9):
            places.append(2 * corner + 0.25 * step * ways[way] + rng.normal(0, 0.05, 2))
            headings_deg.append(90 * way + rng.normal(0, 10))
        corner = corner + ways[way]
    return near(np.array(places[:num_views]), np.array(headings_deg[:num_views]), reach=1.2, rng=rng)


def scattered(num_views: int, *, seed: int = 0) -> csr_array:
    """Views scattered over a square, in no order; each localizes about twenty around it."""
    rng = np.random.default_rng(seed)
    reach = np.sqrt(20 / num_views / np.pi)
    return near(rng.random((num_views, 2)), np.zeros(num_views), reach=reach, rng=rng)


def near(
    places: np.ndarray, headings_deg: np.ndarray, *, reach: float, rng: np.random.Generator
) -> csr_array:
    """Views localize nearby views with a similar direction; the allowed angle shrinks with distance."""
    pairs = cKDTree(places).query_pairs(1.5 * reach, output_type="ndarray")
    u, v = np.concatenate([pairs, pairs[:, ::-1]]).T
    turn_deg = np.abs((headings_deg[u] - headings_deg[v] + 180) % 360 - 180)
    distance = np.linalg.norm(places[u] - places[v], axis=1)
    good = distance / reach + turn_deg / 45 + rng.normal(0, 0.12, len(u)) < 1
    return csr_array((np.ones(good.sum(), bool), (u[good], v[good])), shape=(len(places), len(places)))


def saved_graphs(paths: list[Path], threshold: float) -> list[tuple[str, csr_array]]:
    """Graphs from `slimsfm graph`, in files or in maps, or square matrices named `errors`."""
    files = [
        file for path in paths for file in (sorted(path.glob("graph*.npz")) if path.is_dir() else [path])
    ]
    graphs = []
    for file in files:
        with np.load(file) as stored:
            graph = (
                csr_array(stored["errors"] < threshold) if "errors" in stored else sparse(stored, threshold)
            )
        graphs.append((f"{file.parent.name}/{file.stem}", graph))
    return graphs


def sparse(stored: np.lib.npyio.NpzFile, threshold: float) -> csr_array:
    """The edges of a matrix of errors in CSR format."""
    count = len(stored["names"])
    good = stored["data"] < threshold
    rows = np.repeat(np.arange(count), np.diff(stored["indptr"]))
    entries = (np.ones(good.sum(), bool), (rows[good], stored["indices"][good]))
    return csr_array(entries, shape=(count, count))


if __name__ == "__main__":
    start = perf_counter()
    main()
    print(f"{perf_counter() - start:.0f} s in all")
