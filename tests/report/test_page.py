import re
from html.parser import HTMLParser

import numpy as np
import pycolmap
import pytest

from slimsfm.errors import OutputError
from slimsfm.report import ObjectReport, QueryFrame, write_report
from slimsfm.report.page import report_html

TRUST = ["2.0", "3.0"]  # wrong when sure, references tried
DASH = "\N{EN DASH}"
ADD = ("97.0", "90.0", "70.0")
VOID = {"meta", "img", "link", "br", "hr", "input"}


class Reader(HTMLParser):
    """Reads a page as a browser would, strictly: every tag must be closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.addresses, self.tags = [], [], []
        self.rows, self.heads, self.in_cell = [], [], False
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.addresses += [value for name, value in attributes if name in ("src", "href", "srcset", "data")]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def report(full, reduced, camera, make_row):
    rng = np.random.default_rng(1)
    pose = full.images["1.jpg"].cam_from_world()
    frames = tuple(
        QueryFrame(
            image=rng.integers(0, 255, (240, 320, 3), np.uint8),
            camera=camera,
            estimated_cam_from_world=None if k else pose,
            true_cam_from_world=pose,
            label=f"query/{k}.jpg",
            relative_corner_error=None if k else 0.0,
        )
        for k in range(2)
    )
    rows = (
        make_row("full", match=1.4),
        make_row("dominating", match=0.1, references=1.0, map_bytes=1.1e6, median=np.inf),
        make_row("random", strategy="direct", references=1.5, points=1234.0),
    )
    return ObjectReport(name="A <toy> & co", full=full, reduced=reduced, rows=rows, frames=frames)


def test_the_page_is_whole_html_with_every_part(report):
    html = report_html([report, report], title="Two <objects>")
    page = Reader(html)
    assert page.tags.count("section") == page.tags.count("canvas") == page.tags.count("table") == 2
    assert page.tags.count("img") == 4
    assert "A &lt;toy&gt; &amp; co" in html
    assert "<title>Two &lt;objects&gt;</title>" in html
    assert html.count("query/1.jpg</b> not localized") == 2


def test_the_table_holds_every_row(report):
    head, *rows = Reader(report_html([report], title="")).rows
    assert head[:5] == ["Strategy", "Map", "Images", "Points", "Map size"]
    times = ["30.0", "100.0", "4.0", "7.5"]
    assert rows == [
        ["exhaustive", "full", "4", "30", "24 MB", *ADD, "1.00 %", *TRUST, "30.0", "1400.0", "4.0", "0.7"],
        ["exhaustive", "dominating", "1", "30", "1.1 MB", *ADD, DASH, *TRUST, *times],
        ["direct", "random", "1.5", "1,234", "24 MB", *ADD, "1.00 %", *TRUST, *times],
    ]


def test_degrees_and_centimetres_show_only_where_the_unit_is_known(full, reduced, make_row):
    rows = (make_row("full", deg_cm={1: 11.0, 3: 33.0, 5: 55.0}), make_row("dominating"))
    one = ObjectReport(name="", full=full, reduced=reduced, rows=rows, frames=())
    head, metric, unknown = Reader(report_html([one], title="")).rows
    assert head[5:8] == ["1°-1cm", "3°-3cm", "5°-5cm"]
    assert metric[5:8] == ["11.0", "33.0", "55.0"]
    assert unknown[5:8] == [DASH] * 3


def test_the_page_fetches_nothing(report):
    html = report_html([report], title="")
    addresses = Reader(html).addresses
    assert len(addresses) == 2
    assert all(address.startswith("data:image/jpeg;base64,") for address in addresses)
    assert not re.search(r"https?:|@import|url\(|\bfetch\(|XMLHttpRequest|WebSocket|\bimport\b", html)
    assert "default-src 'none'" in html


def test_an_object_without_rows_and_frames_is_shown(full, reduced):
    bare = ObjectReport(name="bare", full=full, reduced=reduced, rows=(), frames=())
    page = Reader(report_html([bare], title=""))
    assert "table" not in page.tags
    assert "img" not in page.tags
    assert "canvas" in page.tags


def test_equal_input_gives_equal_bytes(report, tmp_path):
    for name in ("a.html", "b.html"):
        write_report(tmp_path / name, [report], title="same", overwrite=False)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.html", "b.html"]


def test_what_is_there_stays_unless_overwriting(report, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        write_report(path, [report], title="new", overwrite=False)
    assert path.read_text() == "mine"
    write_report(path, [report], title="new", overwrite=True)
    assert path.read_text(encoding="utf-8") == report_html([report], title="new")


def test_a_page_of_nothing_is_refused_and_leaves_what_is_there(tmp_path):
    path = tmp_path / "report.html"
    path.write_text("mine")
    with pytest.raises(ValueError, match="at least one object"):
        write_report(path, [], title="", overwrite=True)
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("report.html", "mine")]


def test_a_large_map_makes_no_large_page(full):
    model = pycolmap.Reconstruction(full.model)
    rng = np.random.default_rng(2)
    for xyz in rng.uniform(-1, 1, (30_000, 3)):
        model.add_point3D(xyz, pycolmap.Track(), np.zeros(3, np.uint8))
    large = type(full)(model=model, features=full.features, info=full.info)
    one = ObjectReport(name="large", full=large, reduced=large, rows=(), frames=())
    assert len(report_html([one], title="").encode()) < 1_500_000
