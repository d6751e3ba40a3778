"""Where the images of a reference graph are drawn: near those that localize them well."""

from collections.abc import Collection
from itertools import product
from math import sqrt

import networkx as nx
import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from slimsfm.graph import ReferenceGraph

_SIDE = 0.6  # of a node, over the side that would fill the square
_ITERATIONS = 100  # of the forces; they settle in fewer
_PUSHES = 200  # apart, before more is done
_TO_GRID = (0.2, 0.4, 0.6, 0.8)  # shares of the way to a grid, from which nodes are pushed apart
_SLACKS = (0.2, 0.01)  # between nodes, over their side
_FAINT = 0.02  # pull of an edge that starts at no chosen image, over that of one that does


def node_side(count: int) -> float:
    """Side of the square, in the layout's unit, that each of so many images has to itself."""
    return _SIDE / sqrt(max(count, 1))


def graph_layout(
    graph: ReferenceGraph, threshold: float, seed: int = 0, *, chosen: Collection[str] = ()
) -> Float64[np.ndarray, "n 2"]:
    """Lay a reference graph out by forces [1]: edges pull, the more accurate the stronger, nodes repel.

    Afterwards nodes are pushed apart until squares of `node_side` around them do not overlap and lie within
    the unit square.

    Args:
        graph: The graph.
        threshold: Largest relative corner error of an edge.
        seed: Of where the nodes start: equal arguments give equal layouts.
        chosen: Images, such as a dominating set, around which the others are to gather: edges from other
            images pull faintly.

    Returns:
        For each name of the graph where its middle lies, in the unit square.

    References:
        [1] Fruchterman and Reingold, Graph drawing by force-directed placement, Software: Practice and
            Experience 21, 1991.
    """
    count = len(graph.names)
    if count == 1:
        return np.full((1, 2), 0.5)
    pulls = _pulls(graph, threshold, chosen)
    placed = nx.spring_layout(nx.from_numpy_array(pulls), seed=seed, iterations=_ITERATIONS, scale=1)
    positions = np.array([placed[i] for i in range(count)], np.float64)
    return _apart(_in_square(positions, node_side(count)), node_side(count))


def _pulls(graph: ReferenceGraph, threshold: float, chosen: Collection[str]) -> Float64[np.ndarray, "n n"]:
    """How strongly each two images pull each other: 1 for an edge without any error, 0 at the threshold."""
    accuracy = np.clip(1 - graph.dense() / threshold, 0, 1)
    np.fill_diagonal(accuracy, 0)
    if chosen:
        accuracy *= np.where([name in chosen for name in graph.names], 1.0, _FAINT)[:, None]
    return np.maximum(accuracy, accuracy.T)


def _in_square(positions: Float64[np.ndarray, "n 2"], side: float) -> Float64[np.ndarray, "n 2"]:
    """Stretch positions so that squares around them fill the unit square."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    shares = (positions - low) / np.maximum(high - low, 1e-9)
    return side / 2 + (1 - side) * shares


def _apart(positions: Float64[np.ndarray, "n 2"], side: float) -> Float64[np.ndarray, "n 2"]:
    """Move nodes until no two of their squares overlap.

    They are moved part of the way to cells of a grid, which fills gaps, and pushed apart from there; where
    that gets stuck, with less room between them, then from further on the way.
    """
    grid = _on_grid(positions)
    for share, slack in product(_TO_GRID, _SLACKS):
        pushed = _pushed(positions + share * (grid - positions), side, slack)
        if pushed is not None:
            return pushed
    return grid


def _pushed(
    positions: Float64[np.ndarray, "n 2"], side: float, slack: float
) -> Float64[np.ndarray, "n 2"] | None:
    """Push overlapping squares apart along the axis in which they overlap less; None where some still do."""
    positions = positions.copy()
    for _ in range(_PUSHES):
        pairs = KDTree(positions).query_pairs((1 + slack / 2) * side, p=np.inf, output_type="ndarray")
        if not len(pairs):
            return positions
        i, j = pairs[np.lexsort(pairs.T[::-1])].T
        delta = positions[j] - positions[i]
        axis = np.argmax(np.abs(delta), axis=1)
        ways = delta[np.arange(len(pairs)), axis]
        moves = np.where(ways < 0, -1, 1) * (side * (1 + slack) - np.abs(ways)) / 2
        np.add.at(positions, (i, axis), -moves)
        np.add.at(positions, (j, axis), moves)
        positions = np.clip(positions, side / 2, 1 - side / 2)
    return None


def _on_grid(positions: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    """Put each node into a cell of its own, with the least sum of squared ways."""
    cells = int(np.ceil(np.sqrt(len(positions))))
    middles = (np.arange(cells) + 0.5) / cells
    grid = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    ways = ((positions[:, None] - grid[None]) ** 2).sum(axis=2)
    return grid[linear_sum_assignment(ways)[1]]
