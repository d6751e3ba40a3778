"""`slimsfm frontier`: a table, JSON and curves of what a map can be reduced to."""

import json
from math import inf
from pathlib import Path
from xml.etree import ElementTree

import pytest

from commands import contents, slimsfm
from rendered import MAPPING_FRAMES
from slimsfm.mapping.io import bytes_by_part, write_map

FEW = ("--budgets", 50, 200, "--selectors", "kcover", "--dominators", 1)
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def drawn(boulder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("frontier")
    json_path, curves = folder / "frontier.json", folder / "curves.svg"
    done = slimsfm("frontier", boulder.map_path, *FEW, "--json", json_path, "--curves", curves)
    assert (done.code, done.err.strip()) == (0, "")
    return done.out, json.loads(json_path.read_text()), curves.read_text()


@pytest.fixture
def exact_path(exact, tmp_path) -> Path:
    write_map(exact, tmp_path / "map")
    return tmp_path / "map"


def test_the_table_lists_every_way_and_recommends_one_per_use(boulder, drawn):
    out, data, _ = drawn
    lines = out.splitlines()
    assert lines[0].split()[:3] == ["for", "method", "asked"]
    assert lines[1].split()[:2] == ["full", "map"]
    ways = [line for line in lines if line.startswith(("direct ", "images "))]
    assert len(ways) == len(data["candidates"])
    assert sum(line.rstrip().endswith("recommended") for line in ways) == 2
    assert sum(line.startswith(("for direct: kcover", "for images: dominating")) for line in lines) == 2
    assert lines[-2].startswith(f"{len(ways)} ways to reduce {boulder.map_path} in ")
    assert lines[-1].startswith(f"next: slimsfm reduce {boulder.map_path} ")


def test_the_figures_say_what_the_table_says(boulder, drawn):
    _, data, _ = drawn
    full, candidates = data["full"], data["candidates"]
    assert full["images"] == full["tests"] == MAPPING_FRAMES
    assert full["points"] == len(boulder.map.point3D_ids)
    assert full["bytes"] == bytes_by_part(boulder.map_path)["total"]
    by_points = [one for one in candidates if (one["for"], one["method"]) == ("direct", "kcover")]
    assert [one["points"] for one in by_points] == [50, 200]
    assert full["median_corner_error"] < full["finest_corner_error"]
    assert by_points[0]["bytes"] < by_points[1]["bytes"] < full["bytes"]
    for use in ("direct", "images"):
        (best,) = [one for one in candidates if one["for"] == use and one["recommended"]]
        assert (use, best["method"]) in {("direct", "kcover"), ("images", "dominating")}
        assert any(one["for"] == use and not one["dominated"] for one in candidates)
    for one in candidates:
        assert bool(one["images"]) == (one["for"] == "images")
        assert one["tests"] == MAPPING_FRAMES - len(one["images"])
        assert 0 <= one["add_0.02d"] <= one["add_0.05d"] <= one["add_0.1d"] <= 100
        assert min(one["ms_extract"], one["ms_match"], one["ms_pose"]) > 0
        assert one["ms"] == pytest.approx(one["ms_extract"] + one["ms_match"] + one["ms_pose"])
        # None: infinite, because more than half, or a tenth, are not localized
        median, p90, factor = (
            inf if one[key] is None else one[key]
            for key in ("median_corner_error", "p90_corner_error", "median_factor")
        )
        assert 0 < median <= p90
        assert (median < inf) == (one["add_0.1d"] >= 50)
        floor = full["finest_corner_error"]
        assert one["images"] or factor == pytest.approx(max(median, floor) / floor)


def test_the_curves_show_every_way_twice(drawn):
    _, data, curves = drawn
    root = ElementTree.fromstring(curves)
    assert root.tag == f"{SVG}svg"
    said = " ".join(text.text for text in root.iter(f"{SVG}text"))
    for words in ("dominating, direct", "kcover, direct", "images", "recommended", "full map"):
        assert words in said
    width, height = map(float, root.get("viewBox").split()[2:])
    marks = [(float(one.get("x")), float(one.get("y"))) for one in root.iter(f"{SVG}use")]
    assert len(marks) >= 2 * len(data["candidates"]) + 2 * 2
    assert all(0 <= x <= width and 0 <= y <= height for x, y in marks)


def test_curves_of_an_unknown_format_are_refused_before_any_work(exact_path, tmp_path):
    refusal = slimsfm("frontier", exact_path, *FEW, "--curves", tmp_path / "curves.doc")
    assert refusal.code == 2
    assert ".svg, .png, .pdf" in refusal.err
    assert not (exact_path / "graph-matches.npz").exists()


def test_only_the_graph_is_written_into_the_map(exact_path):
    before = contents(exact_path)
    done = slimsfm("frontier", exact_path, "--budgets", 30, "--uses", "direct", "--selectors", "random")
    assert done.code == 0, done.err
    assert contents(exact_path) == before
    assert slimsfm("frontier", exact_path, *FEW).code == 0
    assert set(contents(exact_path)) - set(before) == {"graph-matches.npz"}


def test_existing_files_are_replaced_only_on_request(exact_path, tmp_path):
    taken = tmp_path / "frontier.json"
    taken.write_text("mine")
    command = ("frontier", exact_path, "--uses", "direct", *FEW, "--json", taken)
    refusal = slimsfm(*command)
    assert (refusal.code, taken.read_text()) == (2, "mine")
    assert str(taken) in refusal.err
    assert slimsfm(*command, "--overwrite").code == 0
    assert json.loads(taken.read_text())["full"]["images"] == 6


def test_files_never_replace_the_map(exact_path):
    before = contents(exact_path)
    for option in ("--json", "--curves"):
        refusal = slimsfm("frontier", exact_path, option, exact_path, "--overwrite")
        assert refusal.code == 2
        assert str(exact_path) in refusal.err
    assert contents(exact_path) == before
