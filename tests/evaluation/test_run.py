import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

import tiny_dataset
from commands import contents
from slimsfm.errors import InputError, OutputError
from slimsfm.evaluation.benchmark import Bench
from slimsfm.evaluation.result_files import digest_of, object_to_json, read_object_result
from slimsfm.evaluation.run import object_path, run_benchmark
from slimsfm.execution import processes
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from tiny_dataset import OPTIONS, TinyDataset, add_object, doing_at

NAMES = ["can", "mug"]
SPANS = {"can": range(2, 10), "mug": range(14, 22)}


def write_object(root, name, boulder):
    """Eight neighbouring frames of the rendered object, two of them queries."""
    images = [f"{number}.png" for number in SPANS[name]]
    queries = [images[2], images[5]]
    add_object(root, name, boulder.map, boulder.photos, queries, [x for x in images if x not in queries])


@pytest.fixture(scope="module")
def dataset(boulder, tmp_path_factory):
    root = tmp_path_factory.mktemp("tiny")
    for name in NAMES:
        write_object(root, name, boulder)
    return TinyDataset(path=root)


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory):
    """A run that nothing interrupted."""
    return run_benchmark(dataset, bench_in(tmp_path_factory.mktemp("whole") / "run"))


@pytest.fixture
def breakable(dataset, tmp_path):
    """The data set at a place of its own, where its objects may be broken."""
    shutil.copytree(dataset.path, tmp_path / "data")
    return TinyDataset(path=tmp_path / "data")


def bench_in(folder, **how):
    return Bench(folder=folder, options=OPTIONS, **how)


def break_object(dataset, name, how):
    (dataset.path / name).mkdir(exist_ok=True)
    (dataset.path / name / "broken").write_text(how)


def mend(dataset, name):
    (dataset.path / name / "broken").unlink()


def without_time(path):
    """The result of an object but for times; what differs is then what was found."""

    def strip(value):
        if isinstance(value, dict):
            return {key: strip(one) for key, one in value.items() if key != "seconds"}
        return [strip(one) for one in value] if isinstance(value, list) else value

    return strip(json.loads(path.read_text()))


def state_of(folder, name):
    """All that a run keeps of an object, and when it was written."""
    maps = folder / "maps" / name
    paths = [object_path(folder, name), *sorted(maps.rglob("*"))]
    return contents(maps), object_path(folder, name).read_bytes(), [one.stat().st_mtime_ns for one in paths]


def assert_equal_runs(run, whole):
    assert digest_of(run.objects) == digest_of(whole.objects)
    assert run.failed == whole.failed == {}
    for name in NAMES:
        found, expected = (without_time(object_path(one.folder, name)) for one in (run, whole))
        assert found == expected
    assert contents(run.folder / "maps") == contents(whole.folder / "maps")
    assert_nothing_half_written(run.folder)


def assert_nothing_half_written(folder):
    names = [path.name for path in folder.rglob("*")]
    assert [name for name in names if name.endswith((".partial", ".old"))] == []


def test_a_run_measures_every_object_and_keeps_what_it_found(whole, dataset):
    assert whole.dataset == f"TinyDataset {dataset.path.name}"
    assert [one.name for one in whole.objects] == NAMES
    assert sorted(path.name for path in whole.folder.iterdir()) == ["maps", "objects", "run.json"]
    for one in whole.objects:
        assert digest_of([read_object_result(object_path(whole.folder, one.name))]) == digest_of([one])
        kept = {path.name for path in (whole.folder / "maps" / one.name / "sift").iterdir()}
        assert kept == {"full", "dominating", "points-100"}
        for variant in ("full", "dominating", "points:100"):
            assert isinstance(read_map(whole.map_path(one.name, "sift", variant)), Map)
    assert_nothing_half_written(whole.folder)


def test_a_run_tells_what_was_asked_for_and_on_what_it_was_measured(whole):
    assert whole.options["variants"] == OPTIONS.variants
    assert whole.options["build"]["extractor"] == "sift"
    assert {"slimsfm", "numpy", "pycolmap", "python", "system", "cpu", "cores", "gpu"} <= set(
        whole.environment
    )
    assert all(whole.environment.values())


def test_a_finished_run_is_read_and_not_measured_again(whole, dataset):
    before = [state_of(whole.folder, name) for name in NAMES]
    again = run_benchmark(dataset, bench_in(whole.folder))
    assert [state_of(whole.folder, name) for name in NAMES] == before
    assert [object_to_json(one) for one in again.objects] == [object_to_json(one) for one in whole.objects]


def interrupted():
    raise KeyboardInterrupt


def test_a_run_that_is_interrupted_again_and_again_finds_the_same(whole, breakable, tmp_path):
    """While it reads its second object, computes the graph, and chooses points."""
    folder = tmp_path / "run"
    break_object(breakable, "mug", "interrupt")
    with pytest.raises(KeyboardInterrupt):
        run_benchmark(breakable, bench_in(folder))
    mend(breakable, "mug")
    done = state_of(folder, "can")
    for stage in ("localize 7 pairs", "find usable points"):
        with pytest.raises(KeyboardInterrupt):
            run_benchmark(breakable, bench_in(folder, progress=doing_at(stage, 1, interrupted)))
        assert [path.name for path in (folder / "objects").iterdir()] == ["can.json"]
    run = run_benchmark(breakable, bench_in(folder))
    assert state_of(folder, "can") == done
    assert_equal_runs(run, whole)


def test_a_run_whose_process_was_killed_goes_on_and_finds_the_same(whole, dataset, tmp_path):
    """SIGKILL leaves no time to clean up: what lay half-written is written anew."""
    folder = tmp_path / "run"
    killed = subprocess.run(
        [sys.executable, "-m", "tiny_dataset", dataset.path, folder, "find usable points", "2"],
        env={**os.environ, "PYTHONPATH": str(Path(tiny_dataset.__file__).parent), "TMPDIR": str(tmp_path)},
        check=False,
        capture_output=True,
    )
    assert killed.returncode == -9, killed.stderr
    done = state_of(folder, "can")
    (folder / "objects" / ".mug.json.partial").write_text('{"name": "mug", "bo')
    half = folder / "maps" / "mug" / "sift" / ".points-100.partial"
    half.mkdir(parents=True)
    (half / "map.json").write_text("{")
    run = run_benchmark(dataset, bench_in(folder))
    assert state_of(folder, "can") == done
    assert_equal_runs(run, whole)


def test_broken_objects_hold_up_no_other_and_are_tried_again(whole, breakable, tmp_path):
    folder = tmp_path / "run"
    break_object(breakable, "can", "input")
    break_object(breakable, "jar", "bug")
    run = run_benchmark(breakable, bench_in(folder))
    assert run.failed == {"can": "its box is missing", "jar": "RuntimeError: it is broken"}
    assert [one.name for one in run.objects] == ["mug"]
    assert [path.name for path in (folder / "objects").iterdir()] == ["mug.json"]
    done = state_of(folder, "mug")
    assert run_benchmark(breakable, bench_in(folder)).failed == run.failed
    mend(breakable, "can")
    run = run_benchmark(breakable, bench_in(folder))
    assert list(run.failed) == ["jar"]
    assert_equal_runs(replace(run, failed={}), whole)
    assert state_of(folder, "mug") == done


def test_what_failed_is_told_to_the_log_unless_its_reader_can_mend_it(breakable, tmp_path, caplog):
    break_object(breakable, "can", "input")
    break_object(breakable, "mug", "bug")
    run_benchmark(breakable, bench_in(tmp_path / "run"))
    (record,) = caplog.records
    assert record.getMessage() == "mug could not be measured"
    assert record.exc_info[1].args == ("it is broken",)


def test_a_run_in_which_everything_failed_leaves_nothing(breakable, tmp_path):
    for name in NAMES:
        break_object(breakable, name, "input")
    run = run_benchmark(breakable, bench_in(tmp_path / "run"))
    assert list(run.failed) == NAMES
    assert run.objects == ()
    assert not (tmp_path / "run").exists()


def test_two_processes_find_what_one_finds(whole, breakable, tmp_path):
    break_object(breakable, "jar", "bug")
    shown = []

    def progress(items, label):
        for item in items:
            shown.append(label)
            yield item

    run = run_benchmark(breakable, bench_in(tmp_path / "run"), partial(processes, 2), progress)
    assert run.failed == {"jar": "RuntimeError: it is broken"}
    assert shown == ["measure objects"] * 3
    assert_equal_runs(replace(run, failed={}), whole)


def test_a_folder_of_other_options_is_refused_until_it_may_be_overwritten(whole, dataset, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole.folder, folder)
    before = contents(folder)
    options = replace(OPTIONS, strategies=("direct",), variants=("full",))
    bench = Bench(folder=folder, options=options)
    with pytest.raises(OutputError, match=r"run: holds a run of other options; choose .* `overwrite=True`"):
        run_benchmark(dataset, bench)
    assert contents(folder) == before
    run = run_benchmark(dataset, bench, overwrite=True)
    assert [cell.key for one in run.objects for cell in one.cells] == [("sift", "direct", "full")] * 2
    assert {path.name for path in (folder / "maps" / "can" / "sift").iterdir()} == {"full"}


def test_another_data_set_and_another_build_are_other_options(whole, dataset, breakable):
    bench = bench_in(whole.folder)
    for other, how in (
        (breakable, bench),
        (dataset, replace(bench, build=replace(bench.build, max_features=100))),
    ):
        with pytest.raises(OutputError, match="a run of other options"):
            run_benchmark(other, how)


def test_a_run_of_the_same_options_goes_on_even_if_it_may_be_overwritten(whole, dataset):
    before = [state_of(whole.folder, name) for name in NAMES]
    run_benchmark(dataset, bench_in(whole.folder), overwrite=True)
    assert [state_of(whole.folder, name) for name in NAMES] == before


@pytest.mark.parametrize("content", ["notes.txt", "run.json"])
def test_a_folder_of_something_else_is_refused(dataset, tmp_path, content):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / content).write_text("mine")
    for overwrite in (False, True):  # what is no run is nobody's to delete
        with pytest.raises(OutputError, match="exists already and is no run"):
            run_benchmark(dataset, bench_in(tmp_path / "run"), overwrite=overwrite)
    assert contents(tmp_path / "run") == {content: b"mine"}


def test_a_file_is_refused(dataset, tmp_path):
    (tmp_path / "run").write_text("mine")
    with pytest.raises(OutputError, match="exists already and is no run"):
        run_benchmark(dataset, bench_in(tmp_path / "run"))
    assert (tmp_path / "run").read_text() == "mine"


def test_a_data_set_without_objects_leaves_no_folder(tmp_path):
    (tmp_path / "data").mkdir()
    with pytest.raises(InputError, match="holds no object"):
        run_benchmark(TinyDataset(path=tmp_path / "data"), bench_in(tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_damaged_result_of_an_object_is_named(whole, dataset, tmp_path):
    shutil.copytree(whole.folder, tmp_path / "run")
    path = object_path(tmp_path / "run", "mug")
    path.write_text(path.read_text()[:1000])
    with pytest.raises(InputError, match=r"mug\.json: is no result of slimsfm benchmark .*delete it"):
        run_benchmark(dataset, bench_in(tmp_path / "run"))


def test_what_a_killed_process_left_in_the_folder_is_in_nobodys_way(dataset, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".run.json.partial").write_text("half")
    options = replace(OPTIONS, strategies=("direct",), variants=("full",))
    assert not run_benchmark(dataset, Bench(folder=tmp_path / "run", options=options)).failed


def test_maps_of_an_object_that_failed_are_not_used_again(breakable, tmp_path):
    told = breakable.path / NAMES[0] / "object.json"
    gone = json.loads(told.read_text()) | {"photos": "nowhere"}
    told.write_text(json.dumps(gone))  # found out when the object is mapped already
    bench = bench_in(tmp_path / "run")
    assert "nowhere" in run_benchmark(breakable, bench).failed[NAMES[0]]
    assert [path.name for path in (bench.folder / "maps").iterdir()] == [NAMES[1]]
