"""Figures in a page and as files."""

import re
from pathlib import Path
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

import slimsfm.report
from slimsfm.errors import OutputError
from slimsfm.report.figures import (
    FIGURE_FORMATS,
    INK,
    PAPER,
    figure_svg,
    new_figure,
    save_figure,
    styled,
)

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


def test_a_figure_in_a_page_takes_the_colors_of_the_page():
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


def test_text_stays_text():
    said = [one.text for one in ElementTree.fromstring(figure_svg(chart())).iter(f"{SVG}text")]
    assert "costs $1 <b> & more" in said
    assert "DejaVu" not in figure_svg(chart())


def test_equal_figures_give_equal_elements_and_different_figures_have_different_ids():
    one, same, other = (figure_svg(chart(values=values)) for values in ((1, 3, 2), (1, 3, 2), (3, 1, 2)))
    assert one == same
    assert ids(one)
    assert not ids(one) & ids(other)
    for svg in (one, other):
        referred = set(re.findall(r"(?:url\(#|href=\"#)([^)\"]+)", svg))
        assert referred == ids(svg)


@pytest.mark.parametrize("suffix", FIGURE_FORMATS)
def test_files_are_complete_and_equal_for_equal_figures(suffix, tmp_path):
    paths = [tmp_path / "deep" / f"{name}{suffix}" for name in "ab"]
    for path in paths:
        save_figure(chart(), path)
    first, second = (path.read_bytes() for path in paths)
    assert first == second
    assert first.startswith(HEADS[suffix])
    assert not re.search(rb"CreationDate|<dc:date>|Matplotlib v", first)
    assert sorted(path.parent.iterdir()) == paths


def test_files_have_a_white_background(tmp_path):
    save_figure(chart(), tmp_path / "a.png")
    pixels = np.asarray(Image.open(tmp_path / "a.png").convert("RGBA"))
    assert pixels[0, 0].tolist() == [255, 255, 255, 255]


def test_an_existing_file_is_replaced_only_on_request(tmp_path):
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


def test_settings_of_matplotlib_are_restored_and_pyplot_is_not_used(tmp_path):
    before = dict(mpl.rcParams)
    save_figure(chart(), tmp_path / "a.svg")
    figure_svg(chart())
    assert dict(mpl.rcParams) == before
    sources = Path(slimsfm.report.__file__).parent.rglob("*.py")
    assert not any("pyplot" in path.read_text(encoding="utf-8") for path in sources)
