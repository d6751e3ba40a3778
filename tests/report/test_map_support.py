"""What the page and the commands say about the maps of a run: support, and doubt."""

import re
import shutil
from dataclasses import replace

import pytest

from commands import slimsfm
from slimsfm.evaluation.result_files import read_run, write_results
from slimsfm.evaluation.results import ObjectResult, Run
from slimsfm.report.map_support import support_html, warnings_html

ANCHORS = {"can": "object-1", "mug": "object-2"}
CONTRADICTIONS = {"003.png": 0.3, "<004>.png": 0.05}


def doubted(result: ObjectResult) -> ObjectResult:
    """The object with a map that its matches contradict."""
    (mapped,) = result.maps
    assert mapped.quality is not None
    origins, pieces = {"001.png": "EXIF"}, (mapped.references,)
    quality = replace(mapped.quality, contradictions=CONTRADICTIONS, focal_origins=origins, pieces=pieces)
    return replace(result, maps=(replace(mapped, quality=quality),))


@pytest.fixture(scope="module")
def in_doubt(run) -> Run:
    """The run, whose second object has a doubted map."""
    return replace(run, objects=(run.objects[0], doubted(run.objects[1])))


def test_right_maps_give_no_warning(run, html):
    assert warnings_html(run, ANCHORS) == ""
    assert "maps are in doubt" not in html


def test_a_doubted_map_is_named_at_the_top_with_its_images(in_doubt):
    warning = warnings_html(in_doubt, ANCHORS)
    assert re.findall(r'<a href="#([^"]+)">([^<]+)</a>, sift: matches contradict', warning) == [
        ("object-2", "mug")
    ]
    assert "003.png (30%)" in warning
    assert "&lt;004&gt;.png (5%)" in warning
    assert "<004>" not in warning


def test_each_object_says_what_supports_its_map(html, run):
    assert html.count('<dl class="support">') == len(run.objects)
    assert "10 of 10 registered" in html
    assert "9 of 9 agree with the model" in html
    assert "none; 9 pairs are trusted to tell" in html
    assert "a &lt;raw&gt; photo was skipped" in html
    assert "<raw>" not in html


def test_contradicted_images_are_listed_with_the_share_of_matches_that_agrees(in_doubt):
    shown = support_html(in_doubt.objects[1].maps[0])
    assert "&lt;004&gt;.png (5%), 003.png (30%): share of the matches" in shown
    assert re.search(r"\d\.\d\d \(EXIF, first image 001\.png\)", shown)


def test_a_map_of_unknown_support_says_so(run):
    unknown = replace(run.objects[0].maps[0], quality=None, notes=())
    assert "not measured" in support_html(unknown)
    assert warnings_html(replace(run, objects=(replace(run.objects[0], maps=(unknown,)),)), ANCHORS) == ""


def test_the_commands_and_the_table_warn_of_a_doubted_map(in_doubt, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(in_doubt.folder, folder, ignore=shutil.ignore_patterns("photos"))
    write_results(replace(in_doubt, folder=folder))
    assert read_run(folder).objects[1].maps == in_doubt.objects[1].maps
    done = slimsfm("report", folder, "-o", tmp_path / "report.html")
    assert (done.code, done.err) == (0, "")
    assert "warning: mug, sift: matches contradict the poses of 2 of 11 images" in done.out
    assert "Poses may be wrong: maps are in doubt" in (tmp_path / "report.html").read_text(encoding="utf-8")
    table = (folder / "table.md").read_text(encoding="utf-8")
    assert "- **warning**: mug, sift: matches contradict" in table
    assert "- can, sift: 10 of 10 photos registered" in table
