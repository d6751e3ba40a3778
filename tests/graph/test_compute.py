"""A graph has equal bytes wherever it is computed, and whichever worker dies."""

import multiprocessing
import os
import shutil
import signal
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from scenes import ALGORITHM_1, algorithm_1, exact_map
from slimsfm.execution import dask_cluster, processes
from slimsfm.graph import GraphOptions, GraphWork, compute_graph
from slimsfm.graph.io import write_graph
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import silent

TIMED_PAIRS = 8  # localized in this process, to choose the size of the blocks
two_processes = partial(processes, 2)


class Counting:
    """Opens an executor and counts the pairs that are submitted to it, each block once."""

    def __init__(self, open_executor):
        self._open_executor = open_executor
        self.blocks = {}

    @contextmanager
    def __call__(self):
        with self._open_executor() as executor:
            yield _Submitting(executor, self.blocks)


class _Submitting(Executor):
    def __init__(self, executor, blocks):
        self._executor, self._blocks = executor, blocks

    def submit(self, function, /, *arguments, **keywords):
        for one in arguments:
            if hasattr(one, "pairs"):
                self._blocks[one.pairs.tobytes()] = len(one.pairs)
        return self._executor.submit(function, *arguments, **keywords)


@pytest.fixture(scope="module")
def a_map(boulder, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("computed") / "map"
    return Path(shutil.copytree(boulder.map_path, folder, ignore=shutil.ignore_patterns("graph-*")))


@pytest.fixture(scope="module", params=["matches", "hybrid", "localize"])
def serial(request, a_map):
    """Options of a source and the bytes of its graph, computed in this process."""
    options = GraphOptions(edges=request.param)
    run = compute_graph(read_map(a_map), options)
    assert run.graph.num_edges() > 100
    return options, bytes_of(run, a_map)


def bytes_of(run, a_map):
    path = a_map.parent / "written.npz"
    write_graph(path, run.graph, pairs_tried=run.pairs_tried)
    return path.read_bytes()


def computed(a_map, options, open_executor, progress=silent):
    """The bytes of a graph, and how many pairs this process localized."""
    counting = Counting(open_executor)
    work = GraphWork(map_path=a_map, open_executor=counting, block_seconds=0.05, min_seconds=0.0)
    run = compute_graph(read_map(a_map), options, work, progress)
    return bytes_of(run, a_map), run.pairs_tried - sum(counting.blocks.values())


def test_processes_give_the_same_bytes(a_map, serial):
    options, expected = serial
    assert computed(a_map, options, two_processes) == (expected, TIMED_PAIRS)


def test_a_dask_cluster_gives_the_same_bytes(a_map, serial, scheduler):
    options, expected = serial
    assert computed(a_map, options, partial(dask_cluster, scheduler, 2)) == (expected, TIMED_PAIRS)


def killing(pid_of):
    """Progress that kills a worker as soon as the second block of work is done."""

    def watch(items, label):
        assert len(items) > 5, label
        for number, item in enumerate(items):
            if number == 2:
                os.kill(pid_of(), signal.SIGKILL)
            yield item

    return watch


def test_a_process_that_is_killed_midway_changes_no_byte(a_map, serial):
    options, expected = serial
    watch = killing(lambda: multiprocessing.active_children()[0].pid)
    assert computed(a_map, options, two_processes, watch) == (expected, TIMED_PAIRS)


def test_a_dask_worker_that_is_killed_midway_changes_no_byte(a_map, serial, scheduler):
    def pid_of_a_worker():
        with dask_cluster(scheduler, 2) as executor:
            return executor.submit(os.getpid).result()

    options, expected = serial
    watch = killing(pid_of_a_worker)
    assert computed(a_map, options, partial(dask_cluster, scheduler, 2), watch) == (expected, TIMED_PAIRS)


def test_a_worker_opens_the_map_that_is_there_now(exact, tmp_path, scheduler):
    path = tmp_path / "map"
    for names in (list(exact.images), list(exact.images)[1:]):
        write_map(keep_images(exact, names), path, overwrite=True)
        map_, counting = read_map(path), Counting(partial(dask_cluster, scheduler, 2))
        work = GraphWork(map_path=path, open_executor=counting, min_seconds=0.0)
        run = compute_graph(map_, ALGORITHM_1, work)
        assert run.pairs_tried - sum(counting.blocks.values()) == TIMED_PAIRS
        assert np.array_equal(run.graph.dense(), algorithm_1(map_).dense())


@pytest.mark.parametrize("block_seconds", [0.0, 0.01, 100.0])
def test_the_size_of_the_blocks_does_not_matter(exact, block_seconds):
    expected = compute_graph(exact, ALGORITHM_1)
    found = compute_graph(exact, ALGORITHM_1, GraphWork(block_seconds=block_seconds))
    assert np.array_equal(found.graph.dense(), expected.graph.dense())
    assert found.pairs_tried == expected.pairs_tried == 15


def test_every_pair_is_tried_once_where_images_fill_several_tiles():
    names = 40  # more than the 32 images of a tile
    run = compute_graph(exact_map(names, 30), GraphOptions(edges="tracks"))
    assert run.pairs_tried == names * (names - 1) // 2
    assert run.graph.num_edges() == names * (names - 1)


def test_the_stages_are_timed(exact):
    run = compute_graph(exact)
    assert list(run.seconds) == ["candidates", "localize", "assemble"]
    assert all(seconds >= 0 for seconds in run.seconds.values())


def test_work_elsewhere_needs_the_map_on_disk():
    with pytest.raises(ValueError, match="map_path must be given with open_executor"):
        GraphWork(open_executor=two_processes)
