import re
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from scenes import graph_from_dense
from slimsfm.report.graph_view import GraphView, dominator_errors, graph_html

NAMES = ("a.png", "b <2>.png", "c.png", "d.png")
ERRORS = np.array(
    [
        [0, 0.01, 0.04, 0.50],
        [0.02, 0, 0.03, 0.90],
        [0.01, 0.01, 0, 0.90],
        [0.90, 0.90, 0.90, 0],
    ]
)
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture
def view(tmp_path):
    for number, name in enumerate(NAMES):
        Image.new("RGB", (640, 480), (40 * number, 100, 100)).save(tmp_path / name)
    graph = graph_from_dense(NAMES, ERRORS)
    return GraphView(graph=graph, threshold=0.05, chosen=("a.png", "d.png"), images=tmp_path, photo_px=64)


def drawn(view):
    """The drawing as an element, its nodes by name and its edges."""
    text = graph_html(view)
    svg = ElementTree.fromstring(text[text.index("<svg") : text.index("</svg>") + 6])
    nodes = {one.get("data-name"): one for one in svg if one.get("data-name")}
    edges = {(int(one.get("data-from")), int(one.get("data-to"))): one for one in svg.iter("path")}
    return text, nodes, edges


def test_each_image_is_a_photo_embedded_once(view):
    text, nodes, _ = drawn(view)
    assert tuple(nodes) == NAMES
    assert text.count("data:image/jpeg") == len(NAMES)
    assert all(len(list(node.iter("image"))) == 1 for node in nodes.values())


def test_the_dominating_set_stands_out(view):
    _, nodes, _ = drawn(view)
    assert [name for name, node in nodes.items() if "kept" in node.get("class")] == ["a.png", "d.png"]


def test_edges_start_in_the_dominating_set_and_lie_below_the_threshold(view):
    _, _, edges = drawn(view)
    assert set(edges) == {(0, 1), (0, 2)}
    assert all(edge.get("class") == "strong" for edge in edges.values())


def test_arrows_end_at_the_border_of_their_image(view):
    _, nodes, edges = drawn(view)
    frames = [next(one.iter("rect")) for one in nodes.values()]
    for (_, end), edge in edges.items():
        x, y = map(float, re.findall(r"L(-?\d+) (-?\d+)", edge.get("d"))[0])
        left, top, width, height = (float(frames[end].get(key)) for key in ("x", "y", "width", "height"))
        gaps = [x - left, left + width - x, y - top, top + height - y]
        assert min(gaps) == pytest.approx(0, abs=1)


def test_nodes_tell_their_degrees_and_who_localizes_them_best(view):
    _, nodes, _ = drawn(view)
    told = {name: node.get("aria-label").replace("\N{NO-BREAK SPACE}", " ") for name, node in nodes.items()}
    assert told["c.png"] == (
        "c.png: localizes 2 others, is localized by 2. "
        "Best from the dominating set: by a.png, off by 4.0 % of d."
    )
    assert told["a.png"] == "a.png: localizes 2 others, is localized by 2. In the dominating set."
    assert told["d.png"].startswith("d.png: localizes 0 others, is localized by 0.")


def test_an_image_that_no_other_dominates_has_no_best(view):
    errors = dominator_errors(view.graph, view.chosen)
    assert errors[0, 1] == 0.01
    assert np.isinf(errors[[1, 2]]).all()
    assert np.isinf(np.diagonal(errors)).all()


def test_photos_that_are_gone_are_told_of_once(view):
    for name in NAMES:
        (view.images / name).unlink()
    text, nodes, _ = drawn(view)
    assert tuple(nodes) == NAMES
    assert text.count("any more") == 1
    assert "<image" not in text


def test_equal_graphs_are_drawn_equally(view):
    assert graph_html(view) == graph_html(view)
