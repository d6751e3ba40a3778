"""The same results wherever work is done, and whoever fails or dies meanwhile."""

import os
from functools import partial

import numpy as np
import pytest

from slimsfm import execution
from slimsfm.errors import WorkError
from slimsfm.execution import dask_cluster, num_cores, processes, run_tasks
from work import Counted, die_at_first, raise_at_first, square

two_processes = partial(processes, 2)
ALWAYS = 1000


@pytest.fixture(scope="module", params=["processes", "dask"])
def elsewhere(request):
    if request.param == "processes":
        return two_processes
    return partial(dask_cluster, request.getfixturevalue("scheduler"), 2)


def collected(function, tasks, open_executor=None):
    found = dict(run_tasks(function, tasks, open_executor))
    return [found[index] for index in range(len(tasks))]


def counted(numbers, special, folder, failures):
    return [Counted(n, folder / "attempts", failures) if n == special else Counted(n) for n in numbers]


@pytest.mark.parametrize("count", [0, 1, 20])
def test_every_task_has_its_result_whatever_the_order(elsewhere, count):
    tasks = np.random.default_rng(count).permutation(count).tolist()
    found = list(run_tasks(square, tasks, elsewhere))
    assert sorted(found) == list(run_tasks(square, tasks)) == [(i, n * n) for i, n in enumerate(tasks)]


def test_here_tasks_are_done_one_after_the_other_as_their_results_are_wanted():
    seen = []
    found = run_tasks(seen.append, [3, 1, 2])
    assert next(found) == (0, None)
    assert seen == [3]
    list(found)
    assert seen == [3, 1, 2]


@pytest.mark.parametrize("alone", [True, False], ids=["alone", "among others"])
def test_a_task_that_raises_twice_may_still_succeed(elsewhere, tmp_path, alone):
    tasks = counted([5] if alone else range(10), 5, tmp_path, failures=2)
    assert collected(raise_at_first, tasks, elsewhere) == [task.number**2 for task in tasks]
    assert (tmp_path / "attempts").stat().st_size == 3


def test_a_task_that_always_raises_is_named_with_its_reason(elsewhere, tmp_path):
    with pytest.raises(WorkError, match="task 7 failed 3 times: number 7 does not want to"):
        collected(raise_at_first, counted(range(10), 7, tmp_path, ALWAYS), elsewhere)


@pytest.mark.parametrize("alone", [True, False], ids=["alone", "among others"])
def test_a_worker_that_dies_changes_no_result(elsewhere, tmp_path, alone):
    tasks = counted([5] if alone else range(10), 5, tmp_path, failures=1)
    assert collected(die_at_first, tasks, elsewhere) == [task.number**2 for task in tasks]
    assert (tmp_path / "attempts").stat().st_size >= 2


def test_a_task_whose_worker_always_dies_is_named(elsewhere, tmp_path):
    with pytest.raises(WorkError, match="task 0 failed 3 times"):
        collected(die_at_first, counted([4], 4, tmp_path, ALWAYS), elsewhere)


def test_who_wants_no_more_results_gets_none(elsewhere):
    found = run_tasks(square, list(range(10)), elsewhere)
    next(found)
    found.close()
    assert list(found) == []


def test_a_dask_cluster_of_this_machine_is_closed_in_the_end():
    with dask_cluster(None, 1) as executor:
        assert executor.submit(square, 3).result() == 9
        worker = executor.submit(os.getpid).result()
    assert worker != os.getpid()
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense"])
def test_a_scheduler_that_is_not_there_is_named(address, monkeypatch):
    monkeypatch.setattr(execution, "_CONNECT_S", 0.3)
    with pytest.raises(WorkError, match=f"{address}: no Dask scheduler answers there"):
        collected(square, [1], partial(dask_cluster, address, 1))


def test_cores_are_those_that_this_process_may_use():
    assert num_cores() == len(os.sched_getaffinity(0))
