"""`slimsfm benchmark` on small data sets, as a user runs it."""

import csv
import json
import re
import shutil

import numpy as np
import pytest

from commands import contents, slimsfm
from rendered import MAPPING_FRAMES, NAME, QUERY_FRAMES
from slimsfm.cli import COMMANDS
from slimsfm.datasets import DATASETS
from slimsfm.evaluation.result_files import digest_of, read_run
from slimsfm.mapping.io import read_map

BRIEF = ("--strategies", "direct", "--variants", "full", "dominating", "random:2", "points:300")


@pytest.fixture(scope="module")
def synthetic(boulder, tmp_path_factory):
    """A run over the rendered object."""
    folder = tmp_path_factory.mktemp("benchmark") / "run"
    arguments = ("benchmark", "synthetic", boulder.folder / "objects", "--objects", NAME)
    done = slimsfm(*arguments, "-o", folder, *BRIEF)
    assert done.code == 0, done.err
    return folder, done


def test_a_run_writes_the_table_in_every_format(synthetic):
    folder, done = synthetic
    data = json.loads((folder / "results.json").read_text())
    assert [(row["strategy"], row["variant"]) for row in data["rows"]] == [
        ("direct", variant) for variant in BRIEF[3:]
    ]
    assert {row["queries"] for row in data["rows"]} == {QUERY_FRAMES}
    full, dominating, random, points = data["rows"]
    assert full["references"] == MAPPING_FRAMES > dominating["references"]
    assert (random["references"], points["points"]) == (2, 300)
    assert full["add_0.1d"] == 100.0
    with (folder / "table.csv").open(newline="") as file:
        assert [row["variant"] for row in csv.DictReader(file)] == list(BRIEF[3:])
    with (folder / "queries.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == QUERY_FRAMES * (3 + 5)
    assert "\\toprule" in (folder / "table.tex").read_text()
    assert f"| {NAME} | sift | direct | points:300 |" in (folder / "table.md").read_text()
    assert all(variant in done.out for variant in BRIEF[3:])
    assert f"{NAME}, sift: {MAPPING_FRAMES} of {MAPPING_FRAMES} photos registered, " in done.out
    assert "warning" not in done.out


def test_a_run_keeps_its_maps_and_records_its_environment(synthetic):
    folder, _ = synthetic
    run = read_run(folder)
    assert run.objects[0].maps[0].quality == read_map(run.map_path(NAME, "sift", "full")).info.quality
    slim = read_map(run.map_path(NAME, "sift", "points:300"))
    assert len(slim.point3D_ids) == 300
    assert {"numpy", "pycolmap", "python", "cpu", "gpu"} <= run.environment.keys()
    assert run.options["reduction"]["seed"] == 0
    assert (run.objects[0].unit, run.failed) == ("metre", {})


def test_the_same_command_measures_nothing_twice(synthetic, boulder):
    folder, _ = synthetic
    before = contents(folder)
    arguments = ("benchmark", "synthetic", boulder.folder / "objects", "--objects", NAME)
    assert slimsfm(*arguments, "-o", folder, *BRIEF).code == 0
    assert contents(folder) == before
    other = slimsfm(*arguments, "-o", folder, "--strategies", "exhaustive")
    assert other.code == 2
    assert f"{folder}: holds a run with other options" in other.err
    assert contents(folder) == before


def test_a_published_layout_gives_the_results_of_the_synthetic_one(synthetic, boulder, tmp_path):
    copied = shutil.copytree(boulder.folder / "objects", tmp_path / "onepose")
    done = slimsfm("benchmark", "onepose", copied, "--frame-step", 1, "-o", tmp_path / "run", *BRIEF)
    assert done.code == 0, done.err
    ours, theirs = read_run(synthetic[0]), read_run(tmp_path / "run")
    assert digest_of(theirs.objects) == digest_of(ours.objects)
    for a, b in zip(ours.objects[0].measurements, theirs.objects[0].measurements, strict=True):
        assert np.array_equal(a.outcomes.error, b.outcomes.error)


def test_photos_give_their_own_ground_truth(boulder, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for path in boulder.mapping.image_paths[8:24]:
        shutil.copy(path, photos / f"{int(path.stem):02d}.png")
    output = tmp_path / "run"
    arguments = ("benchmark", "images", photos, "-o", output, "--query-every", 4)
    done = slimsfm(*arguments, "--strategies", "direct", "--variants", "full", "default")
    assert done.code == 0, done.err
    run = read_run(output)
    (result,) = run.objects
    assert (result.name, result.unit) == ("photos", "unknown")
    full = read_map(run.map_path("photos", "sift", "full"))
    truth = read_map(output / "truth" / "photos" / "pseudo-ground-truth")
    assert [query.path.name for query in result.queries] == list(truth.images)[::4]
    assert not set(full.images) & {query.path.name for query in result.queries}
    assert "n°-n cm: not available" in done.out
    assert f"1 object, {len(result.queries)} queries" in done.out
    assert "1 objects" not in done.out
    assert re.search(r"sift: dominating sets of (1 image|\d+ images);", done.out)


def test_two_runs_are_compared_line_by_line(synthetic, boulder, tmp_path):
    folder, _ = synthetic
    arguments = ("benchmark", "synthetic", boulder.folder / "objects", "--objects", NAME)
    other = tmp_path / "other"
    done = slimsfm(*arguments, "-o", other, "--strategies", "direct", "--variants", "full", "points:50")
    assert done.code == 0, done.err
    compared = slimsfm("benchmark", "--compare", folder / "results.json", other)
    assert compared.code == 0, compared.err
    (line,) = compared.out.splitlines()
    assert line.startswith(f"{NAME}, sift, direct, full compared with sift, direct, full: ")
    assert "ADD-0.1d 100.0 -> 100.0 (+0.0 to +0.0, p 1.000)" in line
    alone = slimsfm("benchmark", "--compare", folder)
    assert (alone.code, "required: AFTER; see slimsfm benchmark --compare --help" in alone.err) == (2, True)
    missing = slimsfm("benchmark", "--compare", folder, tmp_path / "nowhere")
    assert (missing.code, "nowhere" in missing.err) == (2, True)


def test_a_broken_object_does_not_stop_the_others(boulder, tmp_path):
    objects = shutil.copytree(boulder.folder / "objects", tmp_path / "objects")
    broken = shutil.copytree(objects / NAME, objects / "broken")
    pose = next((broken / f"{NAME}-1" / "poses_ba").iterdir())
    pose.write_text("nothing")
    arguments = ("benchmark", "onepose", objects, "--frame-step", 1, "-o", tmp_path / "run", *BRIEF)
    done = slimsfm(*arguments)
    assert done.code == 2
    assert str(pose) in done.err
    assert "1 of 2 objects could not be measured" in done.err
    run = read_run(tmp_path / "run")
    assert [one.name for one in run.objects] == [NAME]
    assert list(run.failed) == ["broken"]


@pytest.mark.parametrize("kind", DATASETS)
def test_every_data_set_explains_itself(kind):
    outcome = slimsfm("benchmark", kind, "--help")
    assert outcome.code == 0
    assert "--strategies" in outcome.out


def test_without_a_data_set_all_are_listed():
    outcome = slimsfm("benchmark", "--help")
    assert all(f"  benchmark {kind} " in outcome.out for kind in DATASETS)


def test_every_data_set_has_a_command():
    named = [name.split()[1] for name in COMMANDS if name.startswith("benchmark ")]
    assert named == [*DATASETS, "--compare"]
