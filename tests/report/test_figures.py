"""Figures as part of a page and as files, and those of maps and graphs."""

import re
from pathlib import Path
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import FancyArrowPatch, Rectangle
from PIL import Image
from slimsfm.report.charts import before_after_figure, cloud_figure, graph_figure
from slimsfm.report.graph_layout import graph_layout, node_side

import slimsfm.report
from scenes import graph_from_dense
from slimsfm.errors import OutputError
from slimsfm.geometry import BOX_EDGES
from slimsfm.report.figures import CHOSEN, FORMATS, INK, PAPER, figure_svg, new_figure, save_figure, styled

SVG = "{http://www.w3.org/2000/svg}"
HEADS = {".svg": b"<?xml", ".png": b"\x89PNG", ".pdf": b"%PDF"}


def chart(*, values=(1.0, 3.0, 2.0), label='a "chart" of <a> & b'):
    with styled():
        figure = new_figure(3.0, 2.0, label)
        axes = figure.subplots()
        axes.plot(values, "o-", clip_on=True)
        axes.plot([2.0], [2.0], "o", fillstyle="left", color=INK, markerfacecoloralt=PAPER)
        axes.set_title("costs $1 <b> & more")
        axes.grid(visible=True)
    return figure


def ids(svg):
    return {one.get("id") for one in ElementTree.fromstring(svg).iter() if one.get("id")}


def test_on_the_page_a_figure_takes_the_pages_colours_and_leaves_the_rest_alone():
    svg = figure_svg(chart())
    root = ElementTree.fromstring(svg)
    assert svg.startswith("<svg")
    assert root.get("aria-label") == 'a "chart" of <a> & b'
    assert root.get("viewBox") == "0 0 216 144"
    assert "currentColor" in svg
    assert "var(--card, #fff)" in svg
    for color in (INK, PAPER, "#000000", "#ffffff", "black", "white"):
        assert color not in svg.lower()
    assert not {f"{SVG}style", f"{SVG}metadata"} & {one.tag for one in root.iter()}
    assert not re.search(r"\d{4}-\d\d-\d\d|matplotlib", svg)


def test_text_stays_text_as_it_was_written():
    said = [one.text for one in ElementTree.fromstring(figure_svg(chart())).iter(f"{SVG}text")]
    assert "costs $1 <b> & more" in said
    assert "DejaVu" not in figure_svg(chart())


def test_equal_figures_give_equal_elements_and_different_ones_share_no_id():
    one, same, other = (figure_svg(chart(values=values)) for values in ((1, 3, 2), (1, 3, 2), (3, 1, 2)))
    assert one == same
    assert ids(one)
    assert not ids(one) & ids(other)
    for svg in (one, other):
        referred = set(re.findall(r"(?:url\(#|href=\"#)([^)\"]+)", svg))
        assert referred == ids(svg)


@pytest.mark.parametrize("suffix", FORMATS)
def test_files_are_whole_and_equal_for_equal_figures(suffix, tmp_path):
    paths = [tmp_path / "deep" / f"{name}{suffix}" for name in "ab"]
    for path in paths:
        save_figure(chart(), path)
    first, second = (path.read_bytes() for path in paths)
    assert first == second
    assert first.startswith(HEADS[suffix])
    assert not re.search(rb"CreationDate|<dc:date>|Matplotlib v", first)
    assert sorted(path.parent.iterdir()) == paths


def test_files_are_on_white(tmp_path):
    save_figure(chart(), tmp_path / "a.png")
    pixels = np.asarray(Image.open(tmp_path / "a.png").convert("RGBA"))
    assert pixels[0, 0].tolist() == [255, 255, 255, 255]


def test_what_is_there_is_replaced_where_asked(tmp_path):
    path = tmp_path / "figure.svg"
    path.write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        save_figure(chart(), path)
    assert path.read_text() == "mine"
    save_figure(chart(), path, overwrite=True)
    assert path.read_text().startswith("<?xml")


@pytest.mark.parametrize("name", ["figure.jpg", "figure"])
def test_unknown_formats_are_refused(name, tmp_path):
    with pytest.raises(OutputError, match=r"\.svg, \.png, \.pdf"):
        save_figure(chart(), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_settings_of_matplotlib_stay_as_they_are_and_pyplots_state_is_left_alone(tmp_path):
    before = dict(mpl.rcParams)
    save_figure(chart(), tmp_path / "a.svg")
    figure_svg(chart())
    assert dict(mpl.rcParams) == before
    sources = Path(slimsfm.report.__file__).parent.rglob("*.py")
    assert not any("pyplot" in path.read_text(encoding="utf-8") for path in sources)


def collection(axes, label):
    return next(one for one in axes.collections if one.get_label() == label)


def test_a_cloud_shows_every_point_camera_and_edge_of_the_box(full):
    (axes,) = cloud_figure(full, ["2.jpg", "3.jpg"]).axes
    points = collection(axes, "points")
    assert len(points.get_offsets()) == 30
    shown = {tuple(row) for row in np.round(255 * points.get_facecolors()[:, :3]).astype(int).tolist()}
    assert shown == {tuple(row) for row in full.colors.tolist()}
    assert len(collection(axes, "box").get_segments()) == len(BOX_EDGES)
    assert len(collection(axes, "chosen").get_segments()) == 2 * 8
    assert len(collection(axes, "dropped").get_segments()) == 2 * 8
    assert to_hex(collection(axes, "chosen").get_color()[0]) == CHOSEN
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    for label in ("box", "chosen", "dropped"):
        corners = np.concatenate(collection(axes, label).get_segments())
        assert (low <= corners).all()
        assert (corners <= high).all()


def test_before_and_after_are_seen_from_one_place(full, reduced):
    before, after = before_after_figure(full, reduced).axes
    assert (before.get_xlim(), before.get_ylim()) == (after.get_xlim(), after.get_ylim())
    np.testing.assert_allclose(
        collection(before, "chosen").get_segments(), collection(after, "chosen").get_segments()
    )
    assert len(collection(before, "dropped").get_segments()) == 3 * 8
    assert not collection(after, "dropped").get_segments()
    kept = {tuple(row) for row in collection(after, "points").get_offsets().tolist()}
    assert len(kept) == 20
    assert kept < {tuple(row) for row in collection(before, "points").get_offsets().tolist()}
    said = [axes.get_title(loc="left") for axes in (before, after)]
    assert said == ["Before: 4 images, 30 points", "After: 1 image, 20 points"]


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


def test_the_graph_shows_each_photo_and_arrows_from_the_dominating_set_alone(two_groups):
    photos = {name: np.full((30, 40, 3), k, np.uint8) for k, name in enumerate(two_groups.names)}
    (axes,) = graph_figure(two_groups, ["00.jpg", "06.jpg"], photos).axes
    layout = graph_layout(two_groups, 0.05, chosen=("00.jpg", "06.jpg"))
    middles = {
        int(one.get_array()[0, 0, 0]): np.reshape(one.get_extent(), (2, 2)).mean(axis=1)
        for one in axes.images
    }
    np.testing.assert_allclose([middles[k] for k in range(12)], layout)
    nodes = {one.get_gid(): one for one in axes.patches if isinstance(one, Rectangle)}
    red = {gid for gid, one in nodes.items() if to_hex(one.get_edgecolor()) == CHOSEN}
    assert len(nodes) == 12
    assert red == {"node 00.jpg", "node 06.jpg"}
    arrows = {one.get_gid(): one for one in axes.patches if isinstance(one, FancyArrowPatch)}
    own = {f"edge 00.jpg {k:02d}.jpg" for k in range(1, 6)} | {
        f"edge 06.jpg {k:02d}.jpg" for k in range(7, 12)
    }
    assert set(arrows) == own | {"edge 06.jpg 05.jpg"}
    faint = {gid for gid, one in arrows.items() if one.get_alpha() < 0.5}
    assert faint == {"edge 06.jpg 05.jpg"}


def test_a_graph_without_photos_names_its_nodes(two_groups):
    (axes,) = graph_figure(two_groups, [], {}).axes
    assert sorted(text.get_text() for text in axes.texts) == list(two_groups.names)
    assert not axes.images


def test_images_that_are_not_in_the_graph_are_refused(two_groups):
    with pytest.raises(ValueError, match=r"dominating.*99\.jpg"):
        graph_figure(two_groups, ["00.jpg", "99.jpg"], {})
