"""Equal bytes wherever a graph is computed, and whoever dies meanwhile."""

import multiprocessing
import os
import shutil
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from scenes import ALGORITHM_1, algorithm_1
from slimsfm.execution import dask_cluster, processes
from slimsfm.graph import GraphOptions, GraphWork, compute, compute_graph
from slimsfm.graph.compute import load_or_compute_graph
from slimsfm.mapping.io import read_map, write_map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import silent

two_processes = partial(processes, 2)


@pytest.fixture
def solved_here(monkeypatch):
    """Any work is worth another process; how many pairs this one localizes is counted."""
    monkeypatch.setattr(compute, "_WORTH_SECONDS", 0.0)
    monkeypatch.setattr(compute, "_BLOCK_SECONDS", 0.05)
    counts, solve = [], compute.solve

    def counted(source, pairs):
        counts.append(len(pairs))
        return solve(source, pairs)

    monkeypatch.setattr(compute, "solve", counted)
    return counts


@pytest.fixture(scope="module")
def a_map(boulder, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("computed") / "map"
    return Path(shutil.copytree(boulder.map_path, folder, ignore=shutil.ignore_patterns("graph-*")))


@pytest.fixture(scope="module", params=["matches", "hybrid", "localize"])
def serial(request, a_map):
    """Options of a source and the bytes of its graph, computed in this process."""
    options = GraphOptions(edges=request.param)
    run = load_or_compute_graph(read_map(a_map), a_map, options)
    assert run.graph.num_edges() > 100
    return options, _taken(a_map)


def _taken(a_map):
    (kept,) = a_map.glob("graph-*")
    found = kept.read_bytes()
    kept.unlink()
    return found


def computed(a_map, options, open_executor, progress=silent):
    load_or_compute_graph(read_map(a_map), a_map, options, open_executor, progress)
    return _taken(a_map)


def test_processes_give_the_same_bytes(a_map, serial, solved_here):
    options, expected = serial
    assert computed(a_map, options, two_processes) == expected
    assert sum(solved_here) == compute._TRIAL


def test_a_dask_cluster_gives_the_same_bytes(a_map, serial, solved_here, scheduler):
    options, expected = serial
    assert computed(a_map, options, partial(dask_cluster, scheduler, 2)) == expected
    assert sum(solved_here) == compute._TRIAL


def killing(pid_of):
    """Progress that kills a worker as soon as the second block of work is done."""

    def watch(items, label):
        assert len(items) > 5, label
        for number, item in enumerate(items):
            if number == 2:
                os.kill(pid_of(), signal.SIGKILL)
            yield item

    return watch


def test_a_process_that_is_killed_midway_changes_no_byte(a_map, serial, solved_here):
    options, expected = serial
    watch = killing(lambda: multiprocessing.active_children()[0].pid)
    assert computed(a_map, options, two_processes, watch) == expected
    assert sum(solved_here) == compute._TRIAL


def test_a_dask_worker_that_is_killed_midway_changes_no_byte(a_map, serial, solved_here, scheduler):
    def pid_of_a_worker():
        with dask_cluster(scheduler, 2) as executor:
            return executor.submit(os.getpid).result()

    options, expected = serial
    watch = killing(pid_of_a_worker)
    assert computed(a_map, options, partial(dask_cluster, scheduler, 2), watch) == expected
    assert sum(solved_here) == compute._TRIAL


def test_a_worker_opens_the_map_that_stands_there_now(exact, tmp_path, scheduler, solved_here):
    path, counts = tmp_path / "map", []
    work = GraphWork(map_path=path, open_executor=partial(dask_cluster, scheduler, 2))
    for names in (list(exact.images), list(exact.images)[1:]):
        write_map(keep_images(exact, names), path, overwrite=True)
        map_ = read_map(path)
        solved_here.clear()
        found = compute_graph(map_, ALGORITHM_1, work).graph
        counts.append(sum(solved_here))
        assert np.array_equal(found.dense(), algorithm_1(map_).dense())
    assert counts == [compute._TRIAL] * 2


@pytest.mark.parametrize("tile", [1, 3, 100])
def test_pairs_are_taken_in_tiles_whatever_their_size(exact, monkeypatch, tile):
    expected = compute_graph(exact, ALGORITHM_1)
    monkeypatch.setattr(compute, "_TILE", tile)
    found = compute_graph(exact, ALGORITHM_1)
    assert np.array_equal(found.graph.dense(), expected.graph.dense())
    assert found.pairs_tried == expected.pairs_tried == 15


def test_the_stages_are_timed(exact):
    run = compute_graph(exact)
    assert list(run.seconds) == ["candidates", "localize", "assemble"]
    assert all(seconds >= 0 for seconds in run.seconds.values())


def test_work_elsewhere_needs_the_map_on_disk():
    with pytest.raises(ValueError, match="map_path must be given with open_executor"):
        GraphWork(open_executor=two_processes)
