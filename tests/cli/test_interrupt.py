"""Ctrl-C or SIGTERM: exit code 130 and no incomplete output."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image

from commands import contents, messages, slimsfm
from slimsfm.graph import GraphOptions
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.mapping.io import read_map
from slimsfm.synthetic.scene import mapping_take

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc to see work begin")
PATIENCE_S = 60
GOES_ON = "run the same command again to resume"


@pytest.fixture
def start(tmp_path):
    """Starts the command in its own process, whose temporary files are in a folder of the test."""
    (tmp_path / "tmp").mkdir()
    processes = []

    def begin(*arguments, how=("-m", "slimsfm")):
        process = subprocess.Popen(
            [sys.executable, *how, *map(str, arguments)],
            env={**os.environ, "TMPDIR": str(tmp_path / "tmp"), "OMP_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        processes.append(process)
        return process

    yield begin
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def opened(process):
    """Names of the files that a process holds open."""
    names = set()
    for link in Path(f"/proc/{process.pid}/fd").iterdir():
        try:
            names.add(os.readlink(link))
        except OSError:
            continue  # closed in the meantime
    return names


def wait_until(process, begun):
    deadline = time.monotonic() + PATIENCE_S
    while not begun():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.001)


def wait_until_localizing(process, a_map):
    partial = a_map / "graph-localize.partial"
    wait_until(process, lambda: str(partial) in opened(process) and partial.stat().st_size >= 65)


def assert_interrupted(process, how, tmp_path, what_now="no incomplete output was left behind"):
    if how == signal.SIGINT:
        os.killpg(process.pid, how)  # as a terminal does
    else:
        process.send_signal(how)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, (out, err)
    assert messages(err) == [f"slimsfm: interrupted; {what_now}"]
    assert list((tmp_path / "tmp").iterdir()) == []


def stopped(process, how, tmp_path):
    """Stop a build; only its work is left."""
    if how != signal.SIGKILL:
        assert_interrupted(process, how, tmp_path, GOES_ON)
    process.kill()
    process.communicate()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".map.build", "tmp"]


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """Eight photos, and the files of the map that they give without interruption."""
    folder, take = tmp_path_factory.mktemp("few"), mapping_take("printed_box", 80, 320, 240, 0)
    (folder / "photos").mkdir()
    for i in range(8):
        Image.fromarray(take.frame(i)).save(folder / "photos" / f"{i}.png", compress_level=1)
    assert slimsfm("build", folder / "photos", "-o", folder / "map").code == 0
    return folder / "photos", contents(folder / "map")


@pytest.mark.parametrize(
    ("how", "stage"),
    [
        (signal.SIGKILL, "extracted/*.npz"),
        (signal.SIGTERM, "extracted/*.npz"),
        (signal.SIGKILL, "matched/*.npz"),
    ],
)
def test_the_same_command_goes_on_with_a_build_that_was_stopped(few, start, tmp_path, how, stage):
    photos, whole = few
    command, work = ("build", photos, "-o", tmp_path / "map"), tmp_path / ".map.build"
    process = start(*command)
    wait_until(process, lambda: list(work.glob(stage)))
    stopped(process, how, tmp_path)
    count = len(list(work.glob("extracted/*.npz")))
    again = slimsfm("build", photos, "-o", tmp_path / "map")
    assert again.code == 0
    assert contents(tmp_path / "map") == whole
    assert not work.exists()
    assert count > 0


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_an_interrupted_reduction_leaves_its_progress_and_nothing_else(boulder, start, tmp_path, how):
    a_map = shutil.copytree(boulder.map_path, tmp_path / "map", ignore=shutil.ignore_patterns("graph-*"))
    before = contents(a_map)
    process = start("reduce", a_map, "-o", tmp_path / "slim", "--edges", "localize")
    wait_until_localizing(process, a_map)
    assert_interrupted(process, how, tmp_path, GOES_ON)
    after = contents(a_map)
    assert len(after.pop("graph-localize.partial")) >= 65
    assert after == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map", "tmp"]


def test_an_interrupted_command_keeps_what_it_would_have_replaced(boulder, start, tmp_path):
    a_map = shutil.copytree(boulder.map_path, tmp_path / "map", ignore=shutil.ignore_patterns("graph-*"))
    (tmp_path / "slim").mkdir()
    (tmp_path / "slim" / "notes.txt").write_text("mine")
    process = start("reduce", a_map, "-o", tmp_path / "slim", "--edges", "localize", "--overwrite")
    wait_until_localizing(process, a_map)
    assert_interrupted(process, signal.SIGINT, tmp_path, GOES_ON)
    assert contents(tmp_path / "slim") == {"notes.txt": b"mine"}


SMALL_BLOCKS = """
from functools import partial
from slimsfm.cli import graph_command, main
find = graph_command.load_or_compute_graph
graph_command.load_or_compute_graph = partial(find, block_seconds=0.02, min_seconds=0.0)
main()
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("workers", [1, 2])
def test_an_interrupted_graph_goes_on_where_it_stopped(boulder, start, tmp_path, how, workers):
    a_map = shutil.copytree(boulder.map_path, tmp_path / "map", ignore=shutil.ignore_patterns("graph-*"))
    before, partial = contents(a_map), a_map / "graph-localize.partial"
    command = ("graph", a_map, "--edges", "localize", "--workers", workers)
    process = start(*command, how=("-c", SMALL_BLOCKS))
    wait_until(process, lambda: partial.exists() and partial.stat().st_size > 65 + 24 * 40)
    assert_interrupted(process, how, tmp_path, GOES_ON)
    after = contents(a_map)
    kept = after.pop("graph-localize.partial")
    assert after == before
    labels = []

    def watch(items, label):
        labels.append(label)
        return iter(items)

    run = load_or_compute_graph(read_map(a_map), a_map, GraphOptions(edges="localize"), progress=watch)
    assert int(labels[0].split()[1]) <= run.pairs_tried - (len(kept) - 65) // 24
    again = slimsfm("graph", a_map, "--edges", "localize")
    assert again.code == 0
    assert not partial.exists()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("command", ["reduce", "frontier"])
def test_an_interrupted_comparison_leaves_nothing(boulder, start, tmp_path, command, how):
    before = contents(boulder.map_path)
    outputs = {
        "reduce": ("-o", tmp_path / "slim"),
        "frontier": ("--uses", "direct", "--json", tmp_path / "f.json", "--curves", tmp_path / "f.svg"),
    }
    process = start(command, boulder.map_path, *outputs[command])
    wait_until(process, lambda: list((tmp_path / "tmp").glob(".slimsfm-*.partial/map")))
    assert_interrupted(process, how, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["tmp"]
    assert contents(boulder.map_path) == before


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_an_interrupted_synthesis_leaves_nothing(start, tmp_path, how):
    process = start("synthesize", "-o", tmp_path / "out", "--objects", "can", "--mapping-frames", 500)
    wait_until(process, lambda: list(tmp_path.glob("out/.slimsfm-*.partial/can/can-1/color_full/*.png")))
    assert_interrupted(process, how, tmp_path)
    assert list((tmp_path / "out").iterdir()) == []


def test_the_next_command_removes_what_a_killed_one_left(boulder, start, tmp_path):
    process = start("frontier", boulder.map_path, "--uses", "direct")
    wait_until(process, lambda: list((tmp_path / "tmp").glob(".slimsfm-*.partial/map")))
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert list((tmp_path / "tmp").iterdir()) != []
    process = start("info", boulder.map_path)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, (out, err)
    assert list((tmp_path / "tmp").iterdir()) == []
