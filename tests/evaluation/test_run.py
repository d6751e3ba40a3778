import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial

import pytest

from commands import contents
from slimsfm.errors import InputError, OutputError
from slimsfm.evaluation.benchmark import BenchmarkSetup
from slimsfm.evaluation.result_files import digest_of, object_to_json, read_object_result
from slimsfm.evaluation.run import object_path, run_benchmark
from slimsfm.execution import processes
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from tiny_dataset import OPTIONS, TinyDataset, add_object, doing_at

NAMES = ["can", "mug"]
SPANS = {"can": range(2, 10), "mug": range(14, 22)}


def write_object(root, name, boulder):
    """Eight neighboring frames of the rendered object, two of them queries."""
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
    """A run without interruption."""
    return run_benchmark(dataset, bench_in(tmp_path_factory.mktemp("whole") / "run"))


@pytest.fixture
def breakable(dataset, tmp_path):
    """A copy of the data set, whose objects may be broken."""
    shutil.copytree(dataset.path, tmp_path / "data")
    return TinyDataset(path=tmp_path / "data")


def bench_in(folder, **how):
    return BenchmarkSetup(folder=folder, options=OPTIONS, **how)


def break_object(dataset, name, how):
    (dataset.path / name).mkdir(exist_ok=True)
    (dataset.path / name / "broken").write_text(how)


def repair(dataset, name):
    (dataset.path / name / "broken").unlink()


def without_time(path):
    """The result of an object without times."""

    def strip(value):
        if isinstance(value, dict):
            return {key: strip(one) for key, one in value.items() if key != "seconds"}
        return [strip(one) for one in value] if isinstance(value, list) else value

    return strip(json.loads(path.read_text()))


def state_of(folder, name):
    """The files of an object in a run, and their modification times."""
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


def test_a_run_measures_every_object_and_stores_the_results(whole, dataset):
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


def test_a_run_stores_its_options_and_environment(whole):
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


def test_a_run_that_is_interrupted_repeatedly_has_the_same_result(whole, breakable, tmp_path):
    """While it reads its second object, computes the graph, and chooses points."""
    folder = tmp_path / "run"
    break_object(breakable, "mug", "interrupt")
    with pytest.raises(KeyboardInterrupt):
        run_benchmark(breakable, bench_in(folder))
    repair(breakable, "mug")
    done = state_of(folder, "can")
    for stage in ("localize 7 pairs", "find usable points"):
        with pytest.raises(KeyboardInterrupt):
            run_benchmark(breakable, bench_in(folder, progress=doing_at(stage, 1, interrupted)))
        assert [path.name for path in (folder / "objects").iterdir()] == ["can.json"]
    run = run_benchmark(breakable, bench_in(folder))
    assert state_of(folder, "can") == done
    assert_equal_runs(run, whole)


def test_a_run_continues_after_its_process_was_killed(whole, dataset, tmp_path):
    """SIGKILL leaves no time to clean up: partial files are written again."""
    folder = tmp_path / "run"
    killed = subprocess.run(
        [sys.executable, "-m", "tiny_dataset", dataset.path, folder, "find usable points", "2"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)},
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


def test_broken_objects_do_not_stop_others_and_are_tried_again(whole, breakable, tmp_path):
    folder = tmp_path / "run"
    break_object(breakable, "can", "input")
    break_object(breakable, "jar", "bug")
    run = run_benchmark(breakable, bench_in(folder))
    assert run.failed == {"can": "its box is missing", "jar": "RuntimeError: it is broken"}
    assert [one.name for one in run.objects] == ["mug"]
    assert [path.name for path in (folder / "objects").iterdir()] == ["mug.json"]
    done = state_of(folder, "mug")
    assert run_benchmark(breakable, bench_in(folder)).failed == run.failed
    repair(breakable, "can")
    run = run_benchmark(breakable, bench_in(folder))
    assert list(run.failed) == ["jar"]
    assert_equal_runs(replace(run, failed={}), whole)
    assert state_of(folder, "mug") == done


def test_unexpected_failures_are_logged(breakable, tmp_path, caplog):
    break_object(breakable, "can", "input")
    break_object(breakable, "mug", "bug")
    run_benchmark(breakable, bench_in(tmp_path / "run"))
    (record,) = caplog.records
    assert record.getMessage() == "mug failed"
    assert record.exc_info[1].args == ("it is broken",)


def test_a_run_in_which_everything_failed_leaves_no_files(breakable, tmp_path):
    for name in NAMES:
        break_object(breakable, name, "input")
    run = run_benchmark(breakable, bench_in(tmp_path / "run"))
    assert list(run.failed) == NAMES
    assert run.objects == ()
    assert not (tmp_path / "run").exists()


def test_two_processes_give_the_result_of_one(whole, breakable, tmp_path):
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


def test_a_run_with_other_options_is_kept_unless_overwrite_is_on(whole, dataset, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole.folder, folder)
    before = contents(folder)
    options = replace(OPTIONS, strategies=("direct",), variants=("full",))
    bench = BenchmarkSetup(folder=folder, options=options)
    with pytest.raises(OutputError, match=r"run: holds a run with other options; choose .* `overwrite=True`"):
        run_benchmark(dataset, bench)
    assert contents(folder) == before
    run = run_benchmark(dataset, bench, overwrite=True)
    assert [cell.key for one in run.objects for cell in one.measurements] == [("sift", "direct", "full")] * 2
    assert {path.name for path in (folder / "maps" / "can" / "sift").iterdir()} == {"full"}


def test_another_data_set_and_another_build_are_other_options(whole, dataset, breakable):
    bench = bench_in(whole.folder)
    for other, how in (
        (breakable, bench),
        (dataset, replace(bench, build=replace(bench.build, max_features=100))),
    ):
        with pytest.raises(OutputError, match="a run with other options"):
            run_benchmark(other, how)


def test_overwrite_continues_a_run_with_the_same_options(whole, dataset):
    before = [state_of(whole.folder, name) for name in NAMES]
    run_benchmark(dataset, bench_in(whole.folder), overwrite=True)
    assert [state_of(whole.folder, name) for name in NAMES] == before


@pytest.mark.parametrize("content", ["notes.txt", "run.json"])
def test_a_folder_with_other_files_is_an_error(dataset, tmp_path, content):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / content).write_text("mine")
    for overwrite in (False, True):  # other files are never deleted
        with pytest.raises(OutputError, match="exists already and is not a run"):
            run_benchmark(dataset, bench_in(tmp_path / "run"), overwrite=overwrite)
    assert contents(tmp_path / "run") == {content: b"mine"}


def test_a_file_as_folder_is_an_error(dataset, tmp_path):
    (tmp_path / "run").write_text("mine")
    with pytest.raises(OutputError, match="exists already and is not a run"):
        run_benchmark(dataset, bench_in(tmp_path / "run"))
    assert (tmp_path / "run").read_text() == "mine"


def test_a_data_set_without_objects_leaves_no_folder(tmp_path):
    (tmp_path / "data").mkdir()
    with pytest.raises(InputError, match="holds no object"):
        run_benchmark(TinyDataset(path=tmp_path / "data"), bench_in(tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_damaged_result_of_an_object_is_named_in_the_error(whole, dataset, tmp_path):
    shutil.copytree(whole.folder, tmp_path / "run")
    path = object_path(tmp_path / "run", "mug")
    path.write_text(path.read_text()[:1000])
    with pytest.raises(InputError, match=r"mug\.json: not a result of slimsfm benchmark .*delete it"):
        run_benchmark(dataset, bench_in(tmp_path / "run"))


def test_leftovers_of_a_killed_process_are_ignored(dataset, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".run.json.partial").write_text("half")
    options = replace(OPTIONS, strategies=("direct",), variants=("full",))
    assert not run_benchmark(dataset, BenchmarkSetup(folder=tmp_path / "run", options=options)).failed


def test_maps_of_an_object_that_failed_are_not_used_again(breakable, tmp_path):
    path = breakable.path / NAMES[0] / "object.json"
    gone = json.loads(path.read_text()) | {"photos": "nowhere"}
    path.write_text(json.dumps(gone))  # detected only after mapping
    bench = bench_in(tmp_path / "run")
    assert "nowhere" in run_benchmark(breakable, bench).failed[NAMES[0]]
    assert [path.name for path in (bench.folder / "maps").iterdir()] == [NAMES[1]]
