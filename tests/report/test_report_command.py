import shutil

import pytest

from commands import slimsfm


def test_the_command_writes_the_same_bytes_as_the_library(run, html, tmp_path):
    path = tmp_path / "report.html"
    outcome = slimsfm("report", run.folder, "-o", path)
    assert (outcome.code, outcome.err) == (0, "")
    assert path.read_text(encoding="utf-8") == html
    again = slimsfm("report", run.folder, "-o", path)
    assert again.code == 2
    assert f"{path}: exists already" in again.err


def no_results(folder):
    (folder / "results.json").unlink()


def damaged_results(folder):
    text = (folder / "results.json").read_text()
    (folder / "results.json").write_text(text[: len(text) // 2])


def no_maps(folder):
    shutil.rmtree(folder / "maps")


@pytest.mark.parametrize(
    ("damage", "named"), [(no_results, "results.json"), (damaged_results, "results.json"), (no_maps, "maps")]
)
def test_a_run_that_cannot_be_shown_is_refused_in_one_line(run, tmp_path, damage, named):
    folder = tmp_path / "run"
    shutil.copytree(run.folder, folder, ignore=shutil.ignore_patterns("photos"))
    damage(folder)
    outcome = slimsfm("report", folder, "-o", tmp_path / "report.html")
    assert outcome.code == 2
    assert outcome.err.count("\n") == 1
    assert str(folder) in outcome.err
    assert named in outcome.err
    assert not (tmp_path / "report.html").exists()
