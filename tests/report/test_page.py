import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise

import cv2
import numpy as np
import pytest
from PIL import Image

from slimsfm.errors import MapError, OutputError
from slimsfm.report import report_html, write_report
from slimsfm.report.frames import photo_uri
from slimsfm.report.report_data import report_budget

VOID = {"meta", "img", "link", "br", "hr", "input"}
BYTES_PER_POINT = 20  # three floats and three bytes, as text


class Reader(HTMLParser):
    """Reads a page strictly: every tag must be closed in order."""

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


def test_the_page_is_well_formed_and_has_every_section_of_every_object(page):
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


def test_the_top_summarizes_gain_and_cost_and_defines_the_accuracy(page):
    top = page.text[: page.text.index("Objects")]
    assert re.search(r"2 objects, 7 queries: the default map, direct, is \S+ smaller, \S+ \S+;", top)
    assert re.search(r"ADD-0.1d 100.0 % → 71.4 %", top)
    assert top.index("box corners are off by less than 0.1 d") < top.index("Size of the map")
    assert "95 % interval" in top
    assert "p 0.5" in top


def test_tables_hold_every_line_of_every_object_and_average(page, run):
    lines = sum(len(one.measurements) for one in run.objects) + 2 * len(run.objects[0].measurements)
    known = {cell.key[1:] for one in run.objects for cell in one.measurements}
    found = [row for row in page.rows if known & set(pairwise(row))]
    assert len(found) == lines
    first = next(row for row in page.rows if row[:2] == ["exhaustive", "full"])
    assert first[2:5] == ["7", "112", first[4]]
    assert first[5:11] == ["100.0"] * 6


def test_failed_objects_are_at_the_top_and_the_environment_is_at_the_bottom(page):
    assert page.text.index("1 object could not be measured") < page.text.index("Size of the map")
    assert "jug: there is no photo" in page.text
    end = page.text[page.text.index("How this was measured") :]
    assert "slimsfm benchmark exact -o run" in end
    assert "a <fast> one" in end
    assert "reduction.threshold0.05" in end


def test_absolute_paths_are_not_shown(alone):
    command = f"slimsfm benchmark exact {alone.folder} -o {alone.folder}/run"
    options = {**alone.options, "command": command, "build": {"masks": str(alone.folder / "masks")}}
    text = Reader(report_html(replace(alone, options=options))).text
    assert "slimsfm benchmark exact run -o run" in text
    assert "build.masksmasks" in text
    assert str(alone.folder) not in text


def test_the_page_fetches_nothing(html, page):
    inside = [address for address in page.addresses if address.startswith(("data:image/jpeg;base64,", "#"))]
    assert inside == page.addresses
    without_names = re.sub(r'xmlns(:xlink)?="[^"]+"', "", html)
    assert not re.search(
        r"https?:|@import|url\((?!#)|\bfetch\(|XMLHttpRequest|WebSocket|\bimport\b", without_names
    )
    assert "default-src 'none'" in html


def test_a_run_without_objects_is_refused_and_the_existing_file_stays(run, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("mine")
    with pytest.raises(ValueError, match="at least one object"):
        write_report(path, replace(run, objects=()), overwrite=True)
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("report.html", "mine")]


@pytest.fixture
def alone(run, tmp_path):
    """A run of one object that a test may damage."""
    folder = tmp_path / "run"
    shutil.copytree(run.folder, folder, ignore=shutil.ignore_patterns("mug"))
    return replace(run, folder=folder, objects=run.objects[:1])


def test_one_object_has_no_averages_and_an_existing_file_is_replaced_only_on_request(alone, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        write_report(path, alone, overwrite=False)
    assert path.read_text() == "mine"
    write_report(path, alone, overwrite=True)
    text = Reader(path.read_text(encoding="utf-8")).text
    assert "Averages" not in text
    assert "1 object, 3 queries" in text


def test_methods_are_named_if_there_are_several(alone):
    can = alone.objects[0]
    twice = replace(
        can, measurements=(*can.measurements, *(replace(cell, method="aliked") for cell in can.measurements))
    )
    text = Reader(report_html(replace(alone, objects=(twice,)))).text
    assert "the default map, direct, with sift, is" in text
    assert "Maps and graph are from sift." in text


def test_missing_photos_are_reported_once(alone, tmp_path):
    can = alone.objects[0]
    queries = tuple(replace(one, path=tmp_path / "gone" / one.path.name) for one in can.queries)
    moved = replace(can, images=tmp_path / "gone", queries=queries)
    html = report_html(replace(alone, objects=(moved,)))
    assert "data:image" not in html
    assert html.count("The photos are not available") == html.count("The query images are not available") == 1
    assert "<canvas" in html


def test_a_run_without_a_map_is_refused(alone):
    shutil.rmtree(alone.map_path("can", "sift", "dominating"))
    with pytest.raises(MapError, match="dominating"):
        report_html(alone)


def test_if_only_the_full_map_was_measured_nothing_is_compared(alone):
    can = alone.objects[0]
    full = replace(can, measurements=tuple(cell for cell in can.measurements if cell.variant == "full"))
    text = Reader(report_html(replace(alone, objects=(full,)))).text
    assert "only the full map was measured" in text
    assert "Where it fails" not in text


def test_six_objects_of_sixty_photos_fit_into_fifteen_megabytes(html, run, tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    photo = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)
    Image.fromarray(photo).save(tmp_path / "photo.png")
    limits = report_budget(6, 60)
    sizes = [len(photo_uri(tmp_path, "photo.png", side) or "") for side in (limits.photo_px, limits.frame_px)]
    each = 2 * limits.points * BYTES_PER_POINT + 60 * sizes[0] + limits.frames * sizes[1]
    assert limits.photo_px >= 64
    assert 6 * (each + len(html) / len(run.objects)) < 15e6


@pytest.mark.parametrize("references", [10, 60, 300, 3000])
def test_less_is_shown_of_each_of_many_objects(references):
    few, many = report_budget(2, references), report_budget(100, references)
    assert few.points > many.points
    assert few.frames > many.frames
    assert few.photo_px >= many.photo_px
    assert references * (few.photo_px**2 * 0.75 * 0.5) <= 1e6
