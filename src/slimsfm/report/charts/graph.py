"""The reference graph as the paper draws it: photos, and arrows from those that are kept."""

from collections.abc import Collection, Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle

from slimsfm.arrays import Image, Points2D
from slimsfm.graph import ReferenceGraph
from slimsfm.report.figures import CHOSEN, DROPPED, INK, new_figure, styled
from slimsfm.report.graph_layout import graph_layout, node_side

_SIDE_IN = 7.5
_FILLED = 0.96  # of a node's square, by its photo


def graph_figure(
    graph: ReferenceGraph,
    dominating: Collection[str],
    thumbnails: Mapping[str, Image],
    threshold: float = 0.05,
) -> Figure:
    """Draw each reference image as a node, those kept with a red border and arrows to all they localize.

    An image lies near the kept ones that localize it well; the arrow from the best of these is the darkest.

    Args:
        graph: The graph.
        dominating: Names of the images that are kept.
        thumbnails: Photos by name, small; a node without one is a plain square with its name.
        threshold: Largest relative corner error of an edge.

    Raises:
        ValueError: An image that is kept is not in the graph.
    """
    if unknown := sorted(set(dominating) - set(graph.names)):
        raise ValueError(f"dominating must name images of the graph, got {unknown[0]!r}")
    positions = graph_layout(graph, threshold, chosen=dominating)
    with styled():
        figure = new_figure(_SIDE_IN, _SIDE_IN, "Which reference images localize which others")
        axes = figure.subplots()
        axes.set_axis_off()
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1)
        halves = {name: _half_sides(thumbnails.get(name), len(graph.names)) for name in graph.names}
        _draw_arrows(axes, graph, dominating, positions, halves, threshold)
        for name, place in zip(graph.names, positions, strict=True):
            _draw_node(axes, name, place, halves[name], thumbnails.get(name), chosen=name in dominating)
    return figure


def _half_sides(photo: Image | None, count: int) -> tuple[float, float]:
    """Half the width and height of a node: its photo fits into its square."""
    height, width = (1, 1) if photo is None else photo.shape[:2]
    scale = _FILLED * node_side(count) / 2 / max(height, width)
    return width * scale, height * scale


def _draw_node(
    axes: Axes, name: str, place: np.ndarray, half: tuple[float, float], photo: Image | None, *, chosen: bool
) -> None:
    (x, y), (dx, dy) = place, half
    if photo is None:
        axes.text(x, y, name.rpartition("/")[2], ha="center", va="center", fontsize=5, clip_on=True, zorder=4)
    else:
        axes.imshow(photo, extent=(x - dx, x + dx, y - dy, y + dy), aspect="auto", zorder=3)
    color, width = (CHOSEN, 2.6) if chosen else (INK if photo is None else DROPPED, 0.6)
    border = Rectangle((x - dx, y - dy), 2 * dx, 2 * dy, fill=False, ec=color, lw=width, zorder=4 + chosen)
    border.set_gid(f"node {name}")
    axes.add_patch(border)


def _draw_arrows(
    axes: Axes,
    graph: ReferenceGraph,
    dominating: Collection[str],
    positions: Points2D,
    halves: Mapping[str, tuple[float, float]],
    threshold: float,
) -> None:
    errors, rows = graph.dense(), [i for i, name in enumerate(graph.names) if name in dominating]
    edges = graph.adjacency(threshold).toarray()
    for v, name in enumerate(graph.names):
        sources = [u for u in rows if edges[u, v]]
        for u in sources:
            best = u == min(sources, key=lambda one: errors[one, v])
            start = _at_border(positions[u], positions[v], halves[graph.names[u]])
            end = _at_border(positions[v], positions[u], halves[name])
            arrow = FancyArrowPatch(
                start,
                end,
                arrowstyle="-|>,head_length=0.35,head_width=0.16",
                mutation_scale=10,
                shrinkA=0,
                shrinkB=1,
                color=CHOSEN,
                alpha=0.75 if best else 0.2,
                lw=1.1 if best else 0.6,
                zorder=2 if best else 1,
                connectionstyle="arc3,rad=0.08",
            )
            arrow.set_gid(f"edge {graph.names[u]} {name}")
            axes.add_patch(arrow)


def _at_border(middle: np.ndarray, towards: np.ndarray, half: tuple[float, float]) -> tuple[float, float]:
    """Where the way from the middle of a node to a place leaves the node."""
    way = towards - middle
    share = min(side / max(abs(step), 1e-12) for side, step in zip(half, way, strict=True))
    x, y = middle + min(share, 1.0) * way
    return float(x), float(y)
