import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise

import cv2
import numpy as np
import pytest
from PIL import Image
from slimsfm.report.budget import budget_for
from slimsfm.report.jpegs import photo_uri

from slimsfm.errors import MapError, OutputError
from slimsfm.report import report_html, write_report

VOID = {"meta", "img", "link", "br", "hr", "input"}
BYTES_PER_POINT = 20  # three floats and three bytes, as text


class Reader(HTMLParser):
    """Reads a page as a browser would, strictly: every tag must be closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.addresses, self.tags, self.ids = [], [], [], []
        self.rows, self.text = [], ""
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [
            value for name, value in attrs if name in ("src", "href", "xlink:href", "srcset", "data")
        ]
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"script", "style"} & set(self.open):
            self.text += data
        if {"td", "th"} & set(self.open) and "small" not in self.open:
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def page(html):
    return Reader(html)


def test_the_page_is_whole_and_has_every_part_of_every_object(page):
    assert page.tags.count("details") == page.tags.count("canvas") == 2
    assert "Exact scenes" in page.text
    for title in (
        "Where it fails",
        "Averages",
        "Reference graph",
        "Queries",
        "Charts",
        "How this was measured",
    ):
        assert title in page.text
    assert len(set(page.ids)) == len(page.ids)


def test_only_the_first_object_is_open(html):
    assert re.findall(r'<details class="card object" id="(object-\d)"( open)?>', html) == [
        ("object-1", " open"),
        ("object-2", ""),
    ]


def test_the_top_says_what_was_gained_and_what_that_cost(page):
    story = page.text[: page.text.index("Objects")]
    assert re.search(r"2 objects, 7 queries: the default map, direct, is \S+ smaller, \S+ \S+;", story)
    assert re.search(r"ADD-0.1d 100.0 % → 71.4 %", story)
    assert "95 % interval" in story
    assert "p 0.5" in story


def test_tables_hold_every_line_of_every_object_and_average(page, run):
    lines = sum(len(one.cells) for one in run.objects) + 2 * len(run.objects[0].cells)
    known = {cell.key[1:] for one in run.objects for cell in one.cells}
    found = [row for row in page.rows if known & set(pairwise(row))]
    assert len(found) == lines
    first = next(row for row in page.rows if row[:2] == ["exhaustive", "full"])
    assert first[2:5] == ["7", "112", first[4]]
    assert first[5:11] == ["100.0"] * 6


def test_what_failed_stands_at_the_top_and_how_it_was_measured_at_the_bottom(page):
    assert page.text.index("1 object could not be measured") < page.text.index("Size of the map")
    assert "jug: there is no photo" in page.text
    end = page.text[page.text.index("How this was measured") :]
    assert "slimsfm benchmark exact -o run" in end
    assert "a <fast> one" in end
    assert "reduction.threshold0.05" in end


def test_the_page_fetches_nothing(html, page):
    inside = [address for address in page.addresses if address.startswith(("data:image/jpeg;base64,", "#"))]
    assert inside == page.addresses
    without_names = re.sub(r'xmlns(:xlink)?="[^"]+"', "", html)
    assert not re.search(
        r"https?:|@import|url\((?!#)|\bfetch\(|XMLHttpRequest|WebSocket|\bimport\b", without_names
    )
    assert "default-src 'none'" in html


def test_a_run_without_objects_is_refused_and_leaves_what_is_there(run, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("mine")
    with pytest.raises(ValueError, match="at least one object"):
        write_report(path, replace(run, objects=()), overwrite=True)
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("report.html", "mine")]


@pytest.fixture
def alone(run, tmp_path):
    """A run of one object, which a test may damage."""
    folder = tmp_path / "run"
    shutil.copytree(run.folder, folder, ignore=shutil.ignore_patterns("mug"))
    return replace(run, folder=folder, objects=run.objects[:1])


def test_one_object_needs_no_averages_and_what_is_there_stays_unless_overwriting(alone, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        write_report(path, alone, overwrite=False)
    assert path.read_text() == "mine"
    write_report(path, alone, overwrite=True)
    text = Reader(path.read_text(encoding="utf-8")).text
    assert "Averages" not in text
    assert "1 object, 3 queries" in text


def test_methods_are_named_where_there_are_several(alone):
    can = alone.objects[0]
    twice = replace(can, cells=(*can.cells, *(replace(cell, method="aliked") for cell in can.cells)))
    text = Reader(report_html(replace(alone, objects=(twice,)))).text
    assert "the default map, direct, with sift, is" in text
    assert "Maps and graph are those of sift." in text


def test_photos_that_are_gone_are_told_of_once(alone, tmp_path):
    can = alone.objects[0]
    queries = tuple(replace(one, path=tmp_path / "gone" / one.path.name) for one in can.queries)
    moved = replace(can, images=tmp_path / "gone", queries=queries)
    html = report_html(replace(alone, objects=(moved,)))
    assert "data:image" not in html
    assert html.count("The photos are not in") == html.count("The query images are not in") == 1
    assert "<canvas" in html


def test_a_run_without_a_map_is_refused(alone):
    shutil.rmtree(alone.map_path("can", "sift", "dominating"))
    with pytest.raises(MapError, match="dominating"):
        report_html(alone)


def test_where_just_the_full_map_was_measured_nothing_is_compared(alone):
    can = alone.objects[0]
    full = replace(can, cells=tuple(cell for cell in can.cells if cell.variant == "full"))
    text = Reader(report_html(replace(alone, objects=(full,)))).text
    assert "just the full map was measured" in text
    assert "Where it fails" not in text


def test_six_objects_of_sixty_photos_fit_into_fifteen_megabytes(html, run, tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    photo = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)
    Image.fromarray(photo).save(tmp_path / "photo.png")
    limits = budget_for(6, 60)
    sizes = [
        len(photo_uri(tmp_path / "photo.png", side) or "") for side in (limits.photo_px, limits.frame_px)
    ]
    each = 2 * limits.points * BYTES_PER_POINT + 60 * sizes[0] + limits.frames * sizes[1]
    assert limits.photo_px >= 64
    assert 6 * (each + len(html) / len(run.objects)) < 15e6


@pytest.mark.parametrize("references", [10, 60, 300, 3000])
def test_the_more_there_is_the_less_is_shown_of_each(references):
    few, many = budget_for(2, references), budget_for(100, references)
    assert few.points > many.points
    assert few.frames > many.frames
    assert few.photo_px >= many.photo_px
    assert references * (few.photo_px**2 * 0.75 * 0.5) <= 1e6
