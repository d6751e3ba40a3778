import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import FancyArrowPatch, Rectangle
from PIL import Image

from scenes import graph_from_dense
from slimsfm.report.figures import CHOSEN
from slimsfm.report.graph_view import GraphDrawing, graph_figure, graph_html, graph_layout, node_side

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
def drawing():
    return GraphDrawing(graph=graph_from_dense(NAMES, ERRORS), threshold=0.05, chosen=("a.png", "d.png"))


@pytest.fixture
def photos(tmp_path):
    for number, name in enumerate(NAMES):
        Image.new("RGB", (640, 480), (40 * number, 100, 100)).save(tmp_path / name)
    return tmp_path


def drawn(drawing, photos):
    """The drawing as an element, its nodes by name, and its edges."""
    text = graph_html(drawing, photos, 64)
    svg = ElementTree.fromstring(text[text.index("<svg") : text.index("</svg>") + 6])
    nodes = {one.get("data-name"): one for one in svg if one.get("data-name")}
    edges = {(int(one.get("data-from")), int(one.get("data-to"))): one for one in svg.iter("path")}
    return text, nodes, edges


def test_each_photo_is_embedded_once(drawing, photos):
    text, nodes, _ = drawn(drawing, photos)
    assert tuple(nodes) == NAMES
    assert text.count("data:image/jpeg") == len(NAMES)
    assert all(len(list(node.iter("image"))) == 1 for node in nodes.values())


def test_the_dominating_set_is_marked(drawing, photos):
    _, nodes, _ = drawn(drawing, photos)
    assert [name for name, node in nodes.items() if "kept" in node.get("class")] == ["a.png", "d.png"]


def test_edges_start_in_the_dominating_set_and_lie_below_the_threshold(drawing, photos):
    _, _, edges = drawn(drawing, photos)
    assert set(edges) == {(0, 1), (0, 2)}
    assert all(edge.get("class") == "strong" for edge in edges.values())


def test_arrows_end_at_the_border_of_their_image(drawing, photos):
    _, nodes, edges = drawn(drawing, photos)
    frames = [next(one.iter("rect")) for one in nodes.values()]
    for (_, end), edge in edges.items():
        x, y = map(float, re.findall(r"L(-?\d+) (-?\d+)", edge.get("d"))[0])
        left, top, width, height = (float(frames[end].get(key)) for key in ("x", "y", "width", "height"))
        gaps = [x - left, left + width - x, y - top, top + height - y]
        assert min(gaps) == pytest.approx(0, abs=1)


def test_nodes_are_described_by_their_degrees_and_their_best_dominating_image(drawing, photos):
    _, nodes, _ = drawn(drawing, photos)
    said = {name: node.get("aria-label").replace("\N{NO-BREAK SPACE}", " ") for name, node in nodes.items()}
    assert said["c.png"] == (
        "c.png: localizes 2 others, is localized by 2. Best from the dominating set: a.png, error 4.0 % of d."
    )
    assert said["a.png"] == "a.png: localizes 2 others, is localized by 2. In the dominating set."
    assert said["d.png"].startswith("d.png: localizes 0 others, is localized by 0.")


def test_only_edges_from_the_dominating_set_have_finite_errors(drawing):
    assert drawing.errors[0, 1] == 0.01
    assert np.isinf(drawing.errors[[1, 2]]).all()
    assert np.isinf(np.diagonal(drawing.errors)).all()


def test_missing_photos_are_reported_once(drawing, tmp_path):
    text, nodes, _ = drawn(drawing, tmp_path)
    assert tuple(nodes) == NAMES
    assert text.count("not available anymore") == 1
    assert str(tmp_path) not in text
    assert "<image" not in text


def test_equal_graphs_are_drawn_equally(drawing, photos):
    assert graph_html(drawing, photos, 64) == graph_html(drawing, photos, 64)


@pytest.fixture(scope="module")
def two_groups():
    """Images 0 to 5 localize each other, best 0 its own, as do 6 to 11; 5 is localized by 6 as well."""
    errors = np.full((12, 12), np.inf)
    errors[:6, :6] = errors[6:, 6:] = 0.03
    errors[0, :6] = errors[6, 6:] = 0.001
    errors[6, 5] = 0.04
    return graph_from_dense(tuple(f"{k:02d}.jpg" for k in range(12)), errors)


@pytest.mark.parametrize("count", [1, 2, 5, 30, 97])
def test_nodes_lie_apart_within_the_square_and_always_in_the_same_place(count):
    places = np.random.default_rng(count).random((count, 2))
    errors = 0.3 * np.linalg.norm(places[:, None] - places[None], axis=2)
    graph = graph_from_dense(tuple(f"{k:03d}" for k in range(count)), errors)
    side = node_side(count)
    for threshold in (0.05, 1e-9):
        layout = graph_layout(graph, threshold)
        assert (layout >= side / 2 - 1e-9).all()
        assert (layout <= 1 - side / 2 + 1e-9).all()
        gaps = np.abs(layout[:, None] - layout[None]).max(axis=2)
        assert (gaps[~np.eye(count, dtype=bool)] >= side * (1 - 1e-9)).all()
        np.testing.assert_array_equal(graph_layout(graph, threshold), layout)


@pytest.mark.parametrize("seed", range(3))
def test_images_gather_around_those_that_localize_them_best(two_groups, seed):
    layout = graph_layout(two_groups, 0.05, seed, chosen=("00.jpg", "06.jpg"))
    ways = np.linalg.norm(layout[:, None] - layout[[0, 6]][None], axis=2)
    assert (ways[:6, 0] < ways[:6, 1]).all()
    assert (ways[6:, 1] < ways[6:, 0]).all()


def test_the_figure_shows_the_nodes_and_edges_of_the_drawing(two_groups):
    drawing = GraphDrawing(graph=two_groups, threshold=0.05, chosen=("00.jpg", "06.jpg"))
    photos = {name: np.full((30, 40, 3), k, np.uint8) for k, name in enumerate(two_groups.names)}
    (axes,) = graph_figure(drawing, photos).axes
    middles = {
        int(one.get_array()[0, 0, 0]): np.reshape(one.get_extent(), (2, 2)).mean(axis=1)
        for one in axes.images
    }
    np.testing.assert_allclose([middles[k] for k in range(12)], drawing.positions * [1000, 750])
    nodes = {one.get_gid(): one for one in axes.patches if isinstance(one, Rectangle)}
    red = {gid for gid, one in nodes.items() if to_hex(one.get_edgecolor()) == CHOSEN}
    assert len(nodes) == 12
    assert red == {"node 00.jpg", "node 06.jpg"}
    arrows = {one.get_gid(): one for one in axes.patches if isinstance(one, FancyArrowPatch)}
    own = {f"edge 0 {k}" for k in range(1, 6)} | {f"edge 6 {k}" for k in range(7, 12)}
    assert set(arrows) == own | {"edge 6 5"}
    faint = {gid for gid, one in arrows.items() if one.get_alpha() < 0.5}
    assert faint == {"edge 6 5"}
    assert set(arrows) == {f"edge {u} {v}" for u, v, _ in drawing.edges()}


def test_a_figure_without_photos_names_its_nodes(two_groups):
    drawing = GraphDrawing(graph=two_groups, threshold=0.05, chosen=())
    (axes,) = graph_figure(drawing, {}).axes
    assert sorted(text.get_text() for text in axes.texts) == list(two_groups.names)
    assert not axes.images


def test_images_that_are_not_in_the_graph_are_refused(two_groups):
    with pytest.raises(ValueError, match=r"chosen.*99\.jpg"):
        GraphDrawing(graph=two_groups, threshold=0.05, chosen=("00.jpg", "99.jpg"))
