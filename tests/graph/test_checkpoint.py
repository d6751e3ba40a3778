"""Progress that survives whatever ends the work."""

import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from scenes import ALGORITHM_1, algorithm_1, exact_map
from slimsfm.errors import OutputError
from slimsfm.graph import GraphOptions
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.graph.edge_sources import all_pairs, graph_key
from slimsfm.graph.io import Checkpoint
from slimsfm.mapping.io import read_map

KEY = "0123456789abcdef" * 4
HEADER, RECORD = 65, 24
PAIRS = np.array([[0, 1], [0, 2], [3, 70_000], [1, 2], [5, 9]])
ERRORS = np.array([[0.1, np.inf], [0.0, 1e-300], [np.inf, np.inf], [1 / 3, 7.0], [0.25, 0.5]])
PATIENCE_S = 60


@pytest.fixture
def path(tmp_path):
    return tmp_path / "graph.partial"


def stored(path, key=KEY):
    with Checkpoint(path, key) as checkpoint:
        return checkpoint.pairs.tolist(), checkpoint.errors.tolist()


def write(path, rows, key=KEY):
    with Checkpoint(path, key) as checkpoint:
        checkpoint.append(PAIRS[rows], ERRORS[rows])


def test_what_was_appended_is_there_again_bit_by_bit(path):
    assert stored(path) == ([], [])
    for rows in ([0, 1], [], [2, 3, 4]):
        write(path, np.array(rows, np.int64))
    assert stored(path) == (PAIRS.tolist(), ERRORS.tolist())
    assert path.stat().st_size == HEADER + len(PAIRS) * RECORD


def test_half_a_record_at_the_end_is_cut_off_wherever_the_file_ends(path):
    write(path, slice(None))
    whole = path.read_bytes()
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        count = max(length - HEADER, 0) // RECORD
        assert stored(path) == (PAIRS[:count].tolist(), ERRORS[:count].tolist())
        assert path.read_bytes() == whole[: HEADER + count * RECORD]
        write(path, slice(count, None))
        assert path.read_bytes() == whole


def test_progress_of_other_work_is_replaced(path):
    write(path, slice(None))
    other = KEY[::-1]
    assert stored(path, other) == ([], [])
    write(path, [4], other)
    assert stored(path, other) == ([[5, 9]], [[0.25, 0.5]])
    path.write_bytes(b"something else")
    assert stored(path) == ([], [])


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match=r"graph\.partial: cannot be written"):
        Checkpoint(tmp_path / "file" / "graph.partial", KEY)
    assert [found.name for found in tmp_path.iterdir()] == ["file"]


def left_to_do(map_, folder, options):
    """Finish a graph and return how many pairs were still to be localized."""
    labels = []

    def watch(items, label):
        labels.append(label)
        return iter(items)

    load_or_compute_graph(map_, folder, options, progress=watch)
    assert len(labels) == 1
    return int(labels[0].split()[1])


def poisoned(path, pairs, key):
    """Write a checkpoint with wrong errors of all pairs."""
    with Checkpoint(path, key) as checkpoint:
        checkpoint.append(pairs, np.full((len(pairs), 2), 123.0))


def test_progress_with_other_options_or_of_another_map_is_not_mixed_in(exact, tmp_path):
    expected = algorithm_1(exact).dense()
    strict = GraphOptions(edges="localize", candidates="likely")
    others = [graph_key(exact, strict), graph_key(exact_map(seed=1), ALGORITHM_1)]
    for number, key in enumerate(others):
        folder = tmp_path / str(number)
        folder.mkdir()
        poisoned(folder / "graph-localize.partial", all_pairs(exact), key)
        assert np.array_equal(load_or_compute_graph(exact, folder, ALGORITHM_1).graph.dense(), expected)
    folder = tmp_path / "same"
    folder.mkdir()
    poisoned(folder / "graph-localize.partial", all_pairs(exact), graph_key(exact, ALGORITHM_1))
    assert load_or_compute_graph(exact, folder, ALGORITHM_1).graph.errors.data.tolist() == [123.0] * 30


SMALL_BLOCKS = """
import sys
from pathlib import Path
from slimsfm.graph import GraphOptions, load_or_compute_graph
from slimsfm.mapping.io import read_map
path, options = Path(sys.argv[1]), GraphOptions(edges="localize", candidates="all")
load_or_compute_graph(read_map(path), path, options, block_seconds=0.02)
"""


def killed_when(a_map, num_records):
    """Start a computation and kill it when this many pairs are done."""
    process = subprocess.Popen(
        [sys.executable, "-c", SMALL_BLOCKS, str(a_map)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    partial, deadline = a_map / "graph-localize.partial", time.monotonic() + PATIENCE_S
    while not (partial.exists() and partial.stat().st_size >= HEADER + num_records * RECORD):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.001)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL


def test_a_killed_computation_resumes_and_ends_with_the_same_bytes(boulder, tmp_path):
    a_map = shutil.copytree(boulder.map_path, tmp_path / "map", ignore=shutil.ignore_patterns("graph-*"))
    undisturbed = shutil.copytree(a_map, tmp_path / "undisturbed")
    map_ = read_map(a_map)
    total = left_to_do(map_, undisturbed, ALGORITHM_1)
    assert total > 400
    done = 0
    for share in (0.0, 0.2, 0.5):
        killed_when(a_map, int(share * total))
        assert not (a_map / "graph-localize.npz").exists()
        before, done = done, (a_map / "graph-localize.partial").stat().st_size - HEADER
        assert done >= before
    assert left_to_do(map_, a_map, ALGORITHM_1) <= total - done // RECORD < total
    assert (a_map / "graph-localize.npz").read_bytes() == (undisturbed / "graph-localize.npz").read_bytes()
    assert not (a_map / "graph-localize.partial").exists()
