"""The reference graph as a drawing whose nodes are the photos; `graph.js` lights it up."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from slimsfm.graph import ReferenceGraph
from slimsfm.report.formatting import percent_of_d, plural
from slimsfm.report.graph_layout import graph_layout, node_side
from slimsfm.report.jpegs import photo_uri

_WIDTH, _HEIGHT = 1000.0, 750.0  # of the drawing: nodes get the shape of most photos
_GAP = 0.92  # a photo's side over its node's
_MOST_EDGES = 4000
_HEAD = 7.0  # length of an arrow's head
_LEAST_PHOTO_PX = 40
_STRONG = ' class="strong"'

_LEGEND = """Each photo is a reference image, the nearer the better they localize each other.
<b class="chosen">Red</b>: the dominating set. An arrow leads from an image of it to one that it localizes;
the strong ones are the most accurate for each image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GraphView:
    """What is drawn of a reference graph."""

    graph: ReferenceGraph
    """The graph."""

    threshold: float
    """Largest relative corner error of an edge."""

    chosen: Collection[str]
    """The dominating set."""

    images: Path
    """Folder of the photos."""

    photo_px: int
    """Longer side of a photo; 0: just those of the dominating set are shown."""


def graph_html(view: GraphView) -> str:
    """The drawing, beside it a place for what is told of the node that is pointed at."""
    places = graph_layout(view.graph, view.threshold, chosen=view.chosen) * (_WIDTH, _HEIGHT)
    nodes = "\n".join(_nodes(view, places))
    missing = "<image" not in nodes
    gone = f"The photos are not in {escape(str(view.images))} any more. " if missing else ""
    count, edges = len(view.graph.names), view.graph.num_edges(view.threshold)
    return f"""<div class="graph">
<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" aria-label="Reference graph of {plural(count, "image")}">
<g class="edges">
{_edges(view, places)}
</g>
{nodes}
</svg>
<div class="told" aria-live="polite"><img alt="" hidden><p>{gone}{_LEGEND}</p>
<p>{plural(count, "image")}, {plural(edges, "edge")}. Point at a photo, tap it, or walk with the arrow
keys.</p></div>
</div>"""


def _nodes(view: GraphView, places: Float64[np.ndarray, "n 2"]) -> Iterator[str]:
    told = _told(view)
    side = node_side(len(places)) * _GAP
    width, height = side * _WIDTH, side * _HEIGHT
    for i, name in enumerate(view.graph.names):
        x, y = places[i] - (width / 2, height / 2)
        frame = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"'
        kept = " kept" * (name in view.chosen)
        yield (
            f'<g class="node{kept}" tabindex="{-1 if i else 0}" role="img" data-name="{escape(name)}" '
            f'aria-label="{escape(name)}: {escape(told[i])}">'
            f'<rect {frame}/>{_photo(view, name, frame)}<rect class="rim" {frame}/></g>'
        )


def _told(view: GraphView) -> list[str]:
    """What is told of each node: its degrees, and how well the dominating set localizes it."""
    out_degrees, in_degrees = (values.tolist() for values in view.graph.degrees(view.threshold))
    errors = dominator_errors(view.graph, view.chosen)
    best = errors.argmin(axis=0)
    told = []
    for i, name in enumerate(view.graph.names):
        error, by = errors[best[i], i], view.graph.names[best[i]]
        degrees = f"localizes {plural(out_degrees[i], 'other')}, is localized by {in_degrees[i]}. "
        if name in view.chosen:
            told.append(f"{degrees}In the dominating set.")
        elif error < view.threshold:
            told.append(f"{degrees}Best from the dominating set: by {by}, off by {percent_of_d(error)}.")
        else:
            told.append(f"{degrees}No image of the dominating set localizes it.")
    return told


def _photo(view: GraphView, name: str, frame: str) -> str:
    if not view.photo_px and name not in view.chosen:
        return ""
    uri = photo_uri(view.images / name, view.photo_px or _LEAST_PHOTO_PX)
    return "" if uri is None else f'<image {frame} preserveAspectRatio="xMidYMid slice" href="{uri}"/>'


def dominator_errors(graph: ReferenceGraph, chosen: Collection[str]) -> Float64[np.ndarray, "n n"]:
    """The errors of the graph from images of the dominating set alone; infinite from others and to itself."""
    errors = graph.dense()
    np.fill_diagonal(errors, np.inf)
    errors[[name not in chosen for name in graph.names]] = np.inf
    return errors


def _edges(view: GraphView, places: Float64[np.ndarray, "n 2"]) -> str:
    """An arrow for each edge from the dominating set; of very many the most accurate for each image."""
    errors = dominator_errors(view.graph, view.chosen)
    ranks = errors.argsort(axis=0, kind="stable").argsort(axis=0, kind="stable")
    pairs = np.argwhere(errors < view.threshold)
    order = np.lexsort((errors[tuple(pairs.T)], ranks[tuple(pairs.T)]))[:_MOST_EDGES]
    half = np.array([_WIDTH, _HEIGHT]) * node_side(len(places)) * _GAP / 2
    kept = np.array([name in view.chosen for name in view.graph.names])
    strong = ((ranks == 0) & ~kept).tolist()
    # the strong ones last, so that they lie above
    return "\n".join(
        f'<path data-from="{u}" data-to="{v}"{_STRONG * strong[u][v]} '
        f'd="{_arrow(places[u], places[v], half)}"/>'
        for u, v in pairs[order[::-1]].tolist()
    )


def _arrow(start: np.ndarray, end: np.ndarray, half: np.ndarray) -> str:
    """A line from the middle of a node to the border of another, with a head."""
    way = end - start
    reach = float(np.min(half / np.maximum(np.abs(way), 1e-9)))
    tip = end - min(reach, 1.0) * way
    along = way / max(float(np.linalg.norm(way)), 1e-9)
    across = np.array([-along[1], along[0]])
    left, right = (tip - _HEAD * (along + side * across / 2) for side in (1, -1))
    return "".join(
        f"{step}{x:.0f} {y:.0f}" for step, (x, y) in zip("MLMLL", (start, tip, left, tip, right), strict=True)
    )
