"""The reference graph as a drawing whose nodes are photos: interactive on the page, and as a figure."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from html import escape
from itertools import product
from math import sqrt
from pathlib import Path

import networkx as nx
import numpy as np
from jaxtyping import Float64
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from slimsfm.arrays import Image
from slimsfm.graph import ReferenceGraph
from slimsfm.report.figures import CHOSEN, DROPPED, INK, new_figure, styled
from slimsfm.report.formatting import format_count, format_error
from slimsfm.report.frames import photo_uri

_WIDTH, _HEIGHT = 1000.0, 750.0  # nodes get the shape of most photos
_FIGURE_IN = 9.0  # width of the figure
_GAP = 0.92  # side of a photo, relative to its node
_MAX_EDGES = 4000
_HEAD = 7.0  # length of an arrow's head
_MIN_PHOTO_PX = 40
_STRONG = ' class="strong"'

_SIDE = 0.6  # of a node, relative to the side that would fill the square
_ITERATIONS = 100  # of the forces, which converge earlier
_PUSHES = 200  # iterations of pushing nodes apart
_TO_GRID = (0.2, 0.4, 0.6, 0.8)  # shares of the way to a grid, tried in order
_SLACKS = (0.2, 0.01)  # between nodes, relative to their side
_FAINT = 0.02  # pull of an edge from an image that is not chosen

_LEGEND = """Each photo is a reference image. Images that localize each other well are close to each other.
<b class="chosen">Red</b>: the dominating set. An arrow leads from an image of the dominating set to an image
that it localizes; strong arrows are the most accurate for each image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GraphDrawing:
    """A reference graph and a dominating set, laid out for drawing."""

    graph: ReferenceGraph
    """The graph."""

    threshold: float
    """Largest relative corner error of an edge."""

    chosen: Collection[str]
    """Names of the dominating set."""

    def __post_init__(self) -> None:
        if unknown := sorted(set(self.chosen) - set(self.graph.names)):
            raise ValueError(f"chosen must name images of the graph, got {unknown[0]!r}")

    @cached_property
    def positions(self) -> Float64[np.ndarray, "n 2"]:
        """Center of each node in the unit square."""
        return graph_layout(self.graph, self.threshold, chosen=self.chosen)

    @cached_property
    def errors(self) -> Float64[np.ndarray, "n n"]:
        """Errors of the edges from the dominating set; infinite for other edges and self-loops."""
        errors = self.graph.dense()
        np.fill_diagonal(errors, np.inf)
        errors[[name not in self.chosen for name in self.graph.names]] = np.inf
        return errors

    def edges(self) -> list[tuple[int, int, bool]]:
        """Edges (source, target, is strong) from the dominating set, strong ones last.

        An edge is strong if it is the most accurate one to an image outside of the dominating set. Of more
        than 4000 edges the most accurate ones per image are returned.
        """
        ranks = self.errors.argsort(axis=0, kind="stable").argsort(axis=0, kind="stable")
        pairs = np.argwhere(self.errors < self.threshold)
        order = np.lexsort((self.errors[tuple(pairs.T)], ranks[tuple(pairs.T)]))[:_MAX_EDGES]
        kept = np.array([name in self.chosen for name in self.graph.names])
        strong = (ranks == 0) & ~kept
        return [(u, v, bool(strong[u, v])) for u, v in pairs[order[::-1]].tolist()]


def graph_html(drawing: GraphDrawing, photos: Path, photo_px: int) -> str:
    """The drawing for the page; `graph.js` highlights nodes and describes them next to the drawing.

    Args:
        drawing: The graph.
        photos: Folder of the photos.
        photo_px: Longer side of a photo; 0 shows only photos of the dominating set.
    """
    places = drawing.positions * (_WIDTH, _HEIGHT)
    nodes = "\n".join(_nodes(drawing, places, photos, photo_px))
    missing = "" if "<image" in nodes else "The photos are not available anymore. "
    count, edges = len(drawing.graph.names), drawing.graph.num_edges(drawing.threshold)
    return f"""<div class="graph">
<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" aria-label="Reference graph of {format_count(count, "image")}">
<g class="edges">
{_edges(drawing, places)}
</g>
{nodes}
</svg>
<div class="details" aria-live="polite"><img alt="" hidden><p>{missing}{_LEGEND}</p>
<p>{format_count(count, "image")}, {format_count(edges, "edge")}. Point at a photo, tap it, or move with the
arrow keys.</p></div>
</div>"""


def _nodes(
    drawing: GraphDrawing, places: Float64[np.ndarray, "n 2"], photos: Path, photo_px: int
) -> Iterator[str]:
    descriptions = _descriptions(drawing)
    width, height = 2 * _half_node(len(places))
    for i, name in enumerate(drawing.graph.names):
        x, y = places[i] - (width / 2, height / 2)
        frame = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"'
        is_chosen = name in drawing.chosen
        uri = photo_uri(photos, name, photo_px or _MIN_PHOTO_PX) if photo_px or is_chosen else None
        photo = f'<image {frame} preserveAspectRatio="xMidYMid slice" href="{uri}"/>' if uri else ""
        yield (
            f'<g class="node{" kept" * is_chosen}" tabindex="{-1 if i else 0}" role="img" '
            f'data-name="{escape(name)}" aria-label="{escape(name)}: {escape(descriptions[i])}">'
            f'<rect {frame}/>{photo}<rect class="rim" {frame}/></g>'
        )


def _descriptions(drawing: GraphDrawing) -> list[str]:
    """Degrees of each node, and how well the dominating set localizes it."""
    graph = drawing.graph
    out_degrees, in_degrees = (values.tolist() for values in graph.degrees(drawing.threshold))
    best = drawing.errors.argmin(axis=0)
    descriptions = []
    for i, name in enumerate(graph.names):
        error = drawing.errors[best[i], i]
        degrees = f"localizes {format_count(out_degrees[i], 'other')}, is localized by {in_degrees[i]}. "
        if name in drawing.chosen:
            descriptions.append(f"{degrees}In the dominating set.")
        elif error < drawing.threshold:
            source = graph.names[best[i]]
            descriptions.append(
                f"{degrees}Best from the dominating set: {source}, error {format_error(error)}."
            )
        else:
            descriptions.append(f"{degrees}No image of the dominating set localizes it.")
    return descriptions


def _half_node(count: int) -> np.ndarray:
    """Half the width and height of a photo."""
    return np.array([_WIDTH, _HEIGHT]) * node_side(count) * _GAP / 2


def _edges(drawing: GraphDrawing, places: Float64[np.ndarray, "n 2"]) -> str:
    half = _half_node(len(places))
    return "\n".join(
        f'<path data-from="{u}" data-to="{v}"{_STRONG * strong} d="{_arrow(places[u], places[v], half)}"/>'
        for u, v, strong in drawing.edges()
    )


def _arrow(start: np.ndarray, end: np.ndarray, half: np.ndarray) -> str:
    """A line from the center of a node to the border of another, with a head."""
    tip = np.array(_at_border(end, start, half))
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    across = np.array([-along[1], along[0]])
    left, right = (tip - _HEAD * (along + side * across / 2) for side in (1, -1))
    return "".join(
        f"{step}{x:.0f} {y:.0f}" for step, (x, y) in zip("MLMLL", (start, tip, left, tip, right), strict=True)
    )


def _at_border(center: np.ndarray, toward: np.ndarray, half: np.ndarray) -> tuple[float, float]:
    """Where the line from the center of a node to another place leaves the node."""
    way = toward - center
    reach = float(np.min(half / np.maximum(np.abs(way), 1e-9)))
    x, y = center + min(reach, 1.0) * way
    return float(x), float(y)


def graph_figure(drawing: GraphDrawing, photos: Mapping[str, Image]) -> Figure:
    """The drawing as a figure.

    Args:
        drawing: The graph.
        photos: Small photos by name; a node without one shows its name.
    """
    places, half = drawing.positions * (_WIDTH, _HEIGHT), _half_node(len(drawing.graph.names))
    with styled():
        size = _FIGURE_IN, _FIGURE_IN * _HEIGHT / _WIDTH
        figure = new_figure(*size, "Which reference images localize which others")
        axes = figure.subplots()
        axes.set_axis_off()
        axes.set(xlim=(0, _WIDTH), ylim=(_HEIGHT, 0), aspect="equal")
        for u, v, strong in drawing.edges():
            ends = _at_border(places[u], places[v], half), _at_border(places[v], places[u], half)
            look = {"alpha": 0.75, "lw": 1.1} if strong else {"alpha": 0.2, "lw": 0.6}
            style = "-|>,head_length=0.35,head_width=0.16"
            arrow = FancyArrowPatch(*ends, arrowstyle=style, mutation_scale=10, shrinkA=0, shrinkB=1)
            arrow.set(color=CHOSEN, zorder=1 + strong, gid=f"edge {u} {v}", **look)
            axes.add_patch(arrow)
        for name, (x, y) in zip(drawing.graph.names, places, strict=True):
            left, right, top, bottom = x - half[0], x + half[0], y - half[1], y + half[1]
            is_chosen, photo = name in drawing.chosen, photos.get(name)
            if photo is None:
                label = name.rpartition("/")[2]
                axes.text(x, y, label, ha="center", va="center", fontsize=5, clip_on=True, zorder=4)
            else:
                axes.imshow(_cropped(photo), extent=(left, right, bottom, top), aspect="auto", zorder=3)
            color, width = (CHOSEN, 2.6) if is_chosen else (INK if photo is None else DROPPED, 0.6)
            rim = Rectangle((left, top), *(2 * half), fill=False, ec=color, lw=width, zorder=4 + is_chosen)
            rim.set_gid(f"node {name}")
            axes.add_patch(rim)
        axes.set(xlim=(0, _WIDTH), ylim=(_HEIGHT, 0))
    return figure


def _cropped(photo: Image) -> Image:
    """The central part of a photo with the shape of a node."""
    height, width = photo.shape[:2]
    shape = _HEIGHT / _WIDTH
    rows, columns = min(height, round(width * shape)), min(width, round(height / shape))
    top, left = (height - rows) // 2, (width - columns) // 2
    return photo[top : top + max(rows, 1), left : left + max(columns, 1)]


def node_side(count: int) -> float:
    """Side of the square, in the layout's unit, that each of `count` images has to itself."""
    return _SIDE / sqrt(max(count, 1))


def graph_layout(
    graph: ReferenceGraph, threshold: float, seed: int = 0, *, chosen: Collection[str] = ()
) -> Float64[np.ndarray, "n 2"]:
    """Lay out a reference graph by forces [1]: accurate edges pull strongly, nodes repel each other.

    Afterwards nodes are pushed apart until squares of `node_side` around them do not overlap and lie within
    the unit square.

    Args:
        graph: The graph.
        threshold: Largest relative corner error of an edge.
        seed: Seed of the initial positions; equal arguments give equal layouts.
        chosen: Images, such as a dominating set, around which the others gather: edges from other images
            pull weakly.

    Returns:
        Center of each node in the unit square.

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
    low, high = positions.min(axis=0), positions.max(axis=0)
    side = node_side(count)
    return _apart(side / 2 + (1 - side) * (positions - low) / np.maximum(high - low, 1e-9), side)


def _pulls(graph: ReferenceGraph, threshold: float, chosen: Collection[str]) -> Float64[np.ndarray, "n n"]:
    """How strongly two images attract each other: 1 for an edge without error, 0 at the threshold."""
    accuracy = np.clip(1 - graph.dense() / threshold, 0, 1)
    np.fill_diagonal(accuracy, 0)
    if chosen:
        accuracy *= np.where([name in chosen for name in graph.names], 1.0, _FAINT)[:, None]
    return np.maximum(accuracy, accuracy.T)


def _apart(positions: Float64[np.ndarray, "n 2"], side: float) -> Float64[np.ndarray, "n 2"]:
    """Move nodes until their squares do not overlap.

    Nodes move part of the way to cells of a grid, which fills gaps, and are pushed apart from there. If that
    does not converge, less space between them is tried, then starting farther along the way.
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
    """Push overlapping squares apart along the axis of less overlap; None if some still overlap."""
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
    """Assign each node to a grid cell of its own with the smallest sum of squared distances."""
    cells = int(np.ceil(np.sqrt(len(positions))))
    middles = (np.arange(cells) + 0.5) / cells
    grid = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    ways = ((positions[:, None] - grid[None]) ** 2).sum(axis=2)
    return grid[linear_sum_assignment(ways)[1]]
