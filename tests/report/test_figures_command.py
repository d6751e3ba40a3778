"""`slimsfm figures`: all figures of a run as files."""

import json
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from commands import Outcome, contents, slimsfm
from slimsfm.evaluation.result_files import read_run
from slimsfm.report.figure_files import DrawnQuery, draw_queries, query_video_frame

SHARED = ("frontier", "reliability-sift")
OF_METHOD = ("before-after", "graph", "sphere", "reliability")


def of_one_object(run, folder):
    """A copy of a run with its first object only, which a test may change."""
    shutil.copytree(run.folder, folder)
    path = folder / "results.json"
    data = json.loads(path.read_text().replace(str(run.folder), str(folder)))
    path.write_text(json.dumps({**data, "objects": data["objects"][:1]}))
    return folder


@pytest.fixture
def small(run, tmp_path):
    return of_one_object(run, tmp_path / "run")


@dataclass(frozen=True)
class Redrawn:
    refusal: Outcome
    done: Outcome
    output: Path


@pytest.fixture(scope="module")
def redrawn(run, tmp_path_factory):
    """Figures of a run without photos, drawn into a folder with other files."""
    folder = tmp_path_factory.mktemp("redrawn")
    small, output = of_one_object(run, folder / "run"), folder / "out"
    shutil.rmtree(small / "photos")
    (output / "can").mkdir(parents=True)
    for name in ("can/frontier.svg", "notes.txt"):
        (output / name).write_text("mine")
    command = ("figures", small, "-o", output, "--format", "svg")
    before = contents(folder)
    refusal = slimsfm(*command)
    assert contents(folder) == before
    return Redrawn(refusal, slimsfm(*command, "--overwrite"), output)


@pytest.fixture(scope="module")
def drawn(run, tmp_path_factory):
    output = tmp_path_factory.mktemp("figures") / "out"
    done = slimsfm("figures", run.folder, "-o", output)
    assert (done.code, done.err.strip()) == (0, "")
    return done.out, output


def files(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def of_object(name, suffix, queries):
    names = {f"{name}/sift/{kind}.{suffix}" for kind in OF_METHOD} | {f"{name}/frontier.{suffix}"}
    return names | {f"{name}/sift/queries/{query}.jpg" for query in queries}


def test_every_figure_of_every_object_is_written(run, drawn):
    _, output = drawn
    expected = {f"{name}.png" for name in SHARED}
    for result in run.objects:
        expected |= of_object(result.name, "png", [query.path.stem for query in result.queries])
    assert {name for name in files(output) if not name.endswith(".mp4")} == expected
    for path in output.rglob("*.png"):
        pixels = np.asarray(Image.open(path).convert("L"))
        assert min(pixels.shape) > 400
        assert pixels.std() > 5


def test_each_file_is_listed_with_an_explanation(drawn):
    out, output = drawn
    listed = [line.split()[0] for line in out.splitlines() if line.startswith(f"{output}/")]
    written = {str(output / name) for name in files(output) if "/queries/" not in name}
    written |= {str(output / name / "sift" / "queries") for name in ("can", "mug")}
    assert set(listed) == written
    assert "accuracy over map size and query time" in out


def test_queries_are_drawn_with_both_boxes_as_images_and_video(run, drawn):
    av = pytest.importorskip("av")
    _, output = drawn
    for result in run.objects:
        folder = output / result.name / "sift"
        for path in (folder / "queries").iterdir():
            pixels = np.asarray(Image.open(path)).astype(int)
            assert (np.abs(pixels - (30, 200, 70)).max(axis=2) < 60).sum() > 100
        with av.open(str(folder / "queries.mp4")) as container:
            assert sum(1 for _ in container.decode(video=0)) == len(result.queries)


def test_queries_of_equal_names_are_numbered_and_missing_photos_are_left_out(run):
    result = run.objects[0]
    paths = [Path(folder, "1.png") for folder in "abc"]
    queries = tuple(replace(one, path=path) for one, path in zip(result.queries, paths, strict=True))
    photo = np.zeros((480, 640, 3), np.uint8)
    outcomes = result.measurements[0].map_runs[0].outcomes
    named = draw_queries(
        replace(result, queries=queries), outcomes, lambda path, _: None if path == paths[1] else photo
    )
    assert [(one.name, one.caption[:3]) for one in named] == [("0000-1", "1/3"), ("0002-1", "3/3")]


def test_every_frame_of_a_video_has_its_size_and_a_caption():
    white = np.full((40, 20, 3), 255, np.uint8)
    for caption, is_longer in (("", False), ("1/2  0.3 % of d", True)):
        frame = query_video_frame(DrawnQuery(name="a", image=white, caption=caption), 120, 200)
        assert frame.shape == (120, 200, 3)
        assert (frame[40:80, 90:110] == 255).all()
        assert (frame[:100, :90] == 0).all()
        assert (frame[100:, :90] > 128).any() == is_longer
    large = query_video_frame(DrawnQuery(name="a", image=np.tile(white, (10, 10, 1)), caption=""), 120, 200)
    assert (large[:100, 70:130] == 255).all()
    assert (large[:, :70] == 0).all()


def test_missing_photos_are_reported_once_and_the_rest_is_drawn(redrawn):
    assert (redrawn.done.code, redrawn.done.err.strip()) == (0, "")
    assert redrawn.done.out.count("no such image") == 1
    assert files(redrawn.output) == of_object("can", "svg", []) | {"notes.txt"}


def test_existing_figures_are_replaced_on_request_and_other_files_stay(redrawn):
    assert redrawn.refusal.code == 2
    assert str(redrawn.output) in redrawn.refusal.err
    assert (redrawn.output / "can" / "frontier.svg").read_text().startswith("<?xml")
    assert (redrawn.output / "notes.txt").read_text() == "mine"


def test_without_pyav_the_command_says_what_to_install_and_continues(small, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    done = slimsfm("figures", small, "-o", tmp_path / "out", "--format", "svg")
    assert done.code == 0, done.err
    assert done.out.count("pip install 'slimsfm[video]'") == 1
    queries = [query.path.stem for query in read_run(small).objects[0].queries]
    assert files(tmp_path / "out") == of_object("can", "svg", queries)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nowhere", "-o", "out"), "nowhere"),
        (("RUN", "-o", "RUN", "--overwrite"), "RUN"),
        (("RUN", "-o", "out", "--format", "jpg"), "jpg"),
        (("RUN",), "output"),
    ],
)
def test_wrong_input_is_refused_in_one_line(small, tmp_path, arguments, said):
    before = contents(small)
    words = [str(small) if word == "RUN" else word for word in arguments]
    words = [str(tmp_path / "out") if word == "out" else word for word in words]
    refusal = slimsfm("figures", *words)
    assert refusal.code == 2
    assert (str(small) if said == "RUN" else said) in refusal.err
    assert refusal.err.count("\n") == 1
    assert not (tmp_path / "out").exists()
    assert contents(small) == before


def test_a_missing_map_is_named(small, tmp_path):
    full = small / "maps" / "can" / "sift" / "full"
    shutil.rmtree(full)
    refusal = slimsfm("figures", small, "-o", tmp_path / "out")
    assert refusal.code == 2
    assert str(full) in refusal.err
