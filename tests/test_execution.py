"""Equal results wherever tasks run, and whichever worker fails or dies."""

import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

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
def test_every_task_has_its_result_in_any_order(elsewhere, count):
    tasks = np.random.default_rng(count).permutation(count).tolist()
    found = list(run_tasks(square, tasks, elsewhere))
    assert sorted(found) == list(run_tasks(square, tasks)) == [(i, n * n) for i, n in enumerate(tasks)]


def test_without_an_executor_tasks_run_one_by_one_on_demand():
    seen = []
    found = run_tasks(seen.append, [3, 1, 2])
    assert next(found) == (0, None)
    assert seen == [3]
    list(found)
    assert seen == [3, 1, 2]


@pytest.mark.parametrize("alone", [True, False], ids=["alone", "among others"])
def test_task_that_fails_twice_succeeds_at_the_third_attempt(elsewhere, tmp_path, alone):
    tasks = counted([5] if alone else range(10), 5, tmp_path, failures=2)
    assert collected(raise_at_first, tasks, elsewhere) == [task.number**2 for task in tasks]
    assert (tmp_path / "attempts").stat().st_size == 3


def test_error_names_a_task_that_always_fails_and_its_reason(elsewhere, tmp_path):
    with pytest.raises(WorkError, match="task 7 failed 3 times: number 7 does not want to"):
        collected(raise_at_first, counted(range(10), 7, tmp_path, ALWAYS), elsewhere)


@pytest.mark.parametrize("alone", [True, False], ids=["alone", "among others"])
def test_dying_worker_changes_no_result(elsewhere, tmp_path, alone):
    tasks = counted([5] if alone else range(10), 5, tmp_path, failures=1)
    assert collected(die_at_first, tasks, elsewhere) == [task.number**2 for task in tasks]
    assert (tmp_path / "attempts").stat().st_size >= 2


def test_error_names_a_task_whose_worker_always_dies(elsewhere, tmp_path):
    with pytest.raises(WorkError, match="task 0 failed 3 times"):
        collected(die_at_first, counted([4], 4, tmp_path, ALWAYS), elsewhere)


def test_closing_the_generator_ends_the_work(elsewhere):
    found = run_tasks(square, list(range(10)), elsewhere)
    next(found)
    found.close()
    assert list(found) == []


def test_local_dask_cluster_is_closed_at_the_end():
    with dask_cluster(None, 1) as executor:
        assert executor.submit(square, 3).result() == 9
        worker = executor.submit(os.getpid).result()
    assert worker != os.getpid()
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense"])
def test_error_names_a_scheduler_that_does_not_answer(address):
    with pytest.raises(WorkError, match=f"{address}: no Dask scheduler answers there"):
        collected(square, [1], partial(dask_cluster, address, 1, timeout_s=0.3))


def test_num_cores_respects_the_affinity_of_the_process():
    assert num_cores() == len(os.sched_getaffinity(0))


KILLS_ITSELF = """
import os, signal
from slimsfm.execution import processes
if __name__ == "__main__":
    with processes(1) as executor:
        print(executor.submit(os.getpid).result(), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_processes_end_with_a_parent_that_is_killed(tmp_path):
    (tmp_path / "script.py").write_text(KILLS_ITSELF)
    command = [sys.executable, tmp_path / "script.py"]
    worker = int(subprocess.run(command, check=False, stdout=subprocess.PIPE).stdout)
    deadline = time.monotonic() + 60
    while Path(f"/proc/{worker}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
