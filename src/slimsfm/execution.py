"""Run many independent tasks: in this process, on local processes, or on a Dask cluster, with equal results.

Tasks are function calls, and every way to run them is a `concurrent.futures.Executor`.
"""

import logging
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    as_completed,
)
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from multiprocessing import get_context, parent_process
from threading import Thread
from typing import TypeVar

from threadpoolctl import threadpool_limits

from slimsfm.errors import WorkError
from slimsfm.limits import Limits, chosen_limits, use_limits
from slimsfm.weights import Runtime, chosen_runtime, use_runtime

Task = TypeVar("Task")
Result = TypeVar("Result")

OpenExecutor = Callable[[], AbstractContextManager[Executor]]
"""Opens an executor; called again when the executor broke."""

_ATTEMPTS = 3
_LOGGER = logging.getLogger(__name__)


def num_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Open a pool of new processes of this machine. Only this process handles Ctrl-C."""
    with ProcessPoolExecutor(count, get_context("spawn"), initializer=_start_worker) as executor:
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


def _start_worker() -> None:
    """Leave Ctrl-C to the parent process, and end with it even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if parent := parent_process():
        parent.join()
        os._exit(1)


@contextmanager
def dask_cluster(address: str | None, workers: int, *, timeout_s: float = 10.0) -> Iterator[Executor]:
    """Open a Dask cluster.

    Args:
        address: Address of its scheduler; None starts a cluster on this machine.
        workers: Number of workers of a cluster on this machine.
        timeout_s: Time within which the scheduler must answer.

    Raises:
        WorkError: Dask is not installed, or no scheduler answers at the address.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise WorkError("Dask is not installed; pip install 'slimsfm[cluster]'") from error
    with ExitStack() as opened:
        try:
            cluster = address or opened.enter_context(
                LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0")
            )
            client = opened.enter_context(Client(cluster, timeout=timeout_s))
        except (OSError, ValueError) as error:
            raise WorkError(f"{address}: no Dask scheduler answers there ({error})") from error
        yield client.get_executor(pure=False)


def map_on_threads(
    function: Callable[[Task], Result], tasks: Iterable[Task], workers: int
) -> Generator[Result, None, None]:
    """Apply a function to tasks on threads of this process and yield the results in the order of the tasks.

    This suits functions that spend their time outside of Python. While they run, the matrix library is
    limited to one thread, so that results are equal for any number of workers. At most two tasks per worker
    are in progress, so the results need not fit into memory.
    """
    waiting: deque[Future[Result]] = deque()
    with threadpool_limits(1), ThreadPoolExecutor(workers) as executor:
        try:
            for task in tasks:
                waiting.append(executor.submit(function, task))
                if len(waiting) == 2 * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            executor.shutdown(wait=False, cancel_futures=True)


def run_tasks(
    function: Callable[[Task], Result], tasks: Sequence[Task], open_executor: OpenExecutor | None = None
) -> Generator[tuple[int, Result], None, None]:
    """Apply a function to every task and yield (index, result) in the order of completion.

    A task that fails, or whose worker dies, is retried, on another worker if there is one.

    Args:
        function: A function that can be imported by name and returns equal results for equal tasks.
        tasks: Arguments of the function.
        open_executor: Opens the executor; None runs one task after the other in this process.

    Raises:
        WorkError: A task failed three times, or three executors in a row broke without a result; the message
            names the task.
    """
    if open_executor is None:
        for index, task in enumerate(tasks):
            yield index, function(task)
        return
    function = partial(_as_here, chosen_runtime(), chosen_limits(), function)
    pending = dict(enumerate(tasks))
    failures: Counter[int] = Counter()
    while pending:
        before = len(pending)
        with open_executor() as executor:
            broke = yield from _one_round(function, pending, executor, failures)
        if broke and len(pending) == before:
            failures.update(pending.keys())
        _check(failures)


def _as_here(
    runtime: Runtime | None, limits: Limits | None, function: Callable[[Task], Result], task: Task
) -> Result:
    """Run a task on a worker with the runtime and the limits of the process that submits it."""
    with ExitStack() as restoring:
        if runtime:
            restoring.enter_context(use_runtime(runtime))
        if limits:
            restoring.enter_context(use_limits(limits))
        return function(task)


def _one_round(
    function: Callable[[Task], Result], pending: dict[int, Task], executor: Executor, failures: Counter[int]
) -> Generator[tuple[int, Result], None, bool]:
    """Run all pending tasks once and remove those that succeed. Returns whether the executor broke."""
    try:
        futures = {executor.submit(function, task): index for index, task in pending.items()}
        for future in as_completed(futures):
            index = futures.pop(future)
            error = BrokenExecutor() if future.cancelled() else future.exception()
            if isinstance(error, BrokenExecutor):
                _LOGGER.warning("a worker died; retrying %d tasks: %s", len(pending), _named(pending))
                return True  # the other tasks of this round are lost too; a new executor runs them
            if error is not None:
                failures[index] += 1
                _check(failures, error)
                _LOGGER.warning("task %d failed; retrying it: %s", index, error)
                continue
            del pending[index]
            yield index, future.result()
    except BrokenExecutor:
        return True
    return False


def _named(pending: dict[int, Task]) -> str:
    first = ", ".join(str(index) for index in list(pending)[:5])
    return first + (", ..." if len(pending) > 5 else "")


def _check(failures: Counter[int], error: BaseException | None = None) -> None:
    worst = max(failures, key=failures.__getitem__, default=None)
    if worst is not None and failures[worst] >= _ATTEMPTS:
        why = f": {error}" if error else " (its worker died each time)"
        raise WorkError(f"task {worst} failed {_ATTEMPTS} times{why}") from error
