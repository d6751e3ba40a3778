"""Many independent pieces of work through one seam, `concurrent.futures.Executor`.

Knows only functions: serial, on processes of this machine, or on a Dask cluster, the results are the same.
"""

import logging
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
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import partial
from multiprocessing import get_context
from os import sched_getaffinity
from typing import TypeVar

from threadpoolctl import threadpool_limits

from slimsfm.errors import WorkError
from slimsfm.weights import Runtime, chosen_runtime, use_runtime

Task = TypeVar("Task")
Result = TypeVar("Result")

OpenExecutor = Callable[[], AbstractContextManager[Executor]]
"""Opens the means of execution; called anew when it broke."""

_ATTEMPTS = 3
_CONNECT_S = 10  # a scheduler that answers does so at once
_LOGGER = logging.getLogger(__name__)


def num_cores() -> int:
    """Cores that this process may use."""
    return len(sched_getaffinity(0))


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Processes of this machine, each started afresh; Ctrl-C is for this one to handle."""
    ignore = (signal.SIGINT, signal.SIG_IGN)
    with ProcessPoolExecutor(
        count, get_context("spawn"), initializer=signal.signal, initargs=ignore
    ) as executor:
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


@contextmanager
def dask_cluster(address: str | None, workers: int) -> Iterator[Executor]:
    """The Dask cluster whose scheduler has this address, or one of this machine with so many workers.

    Raises:
        WorkError: Dask is not installed, or nothing answers at the address.
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
            client = opened.enter_context(Client(cluster, timeout=_CONNECT_S))
        except (OSError, ValueError) as error:
            raise WorkError(f"{address}: no Dask scheduler answers there ({error})") from error
        yield client.get_executor(pure=False)


def on_threads(
    function: Callable[[Task], Result], tasks: Iterable[Task], workers: int
) -> Generator[Result, None, None]:
    """Apply a function to tasks on threads of this process; results come in the order of the tasks.

    For functions that spend their time outside of Python. While they run, the matrix library keeps to one
    thread of its own, so that results are equal for any number of workers. At most twice as many tasks as
    workers are under way, so results need not fit into memory.
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
    """Apply a function to every task and yield (index, result) as they are done, in whatever order.

    A task that fails, or whose worker dies, is tried again, by another worker where there is one.

    Args:
        function: Importable by name, and equal for equal tasks.
        tasks: What it is applied to.
        open_executor: Where the work is done; None: here, one task after the other.

    Raises:
        WorkError: A task failed three times, or three executors broke without a single result between; the
            message names the task.
    """
    if open_executor is None:
        for index, task in enumerate(tasks):
            yield index, function(task)
        return
    function = partial(_with_runtime, chosen_runtime(), function)
    pending = dict(enumerate(tasks))
    failures: Counter[int] = Counter()
    while pending:
        before = len(pending)
        with open_executor() as executor:
            broke = yield from _one_round(function, pending, executor, failures)
        if broke and len(pending) == before:
            failures.update(pending.keys())
        _check(failures)


def _with_runtime(runtime: Runtime | None, function: Callable[[Task], Result], task: Task) -> Result:
    """Run a task on a worker with the runtime of the process that submits it."""
    with use_runtime(runtime) if runtime else nullcontext():
        return function(task)


def _one_round(
    function: Callable[[Task], Result], pending: dict[int, Task], executor: Executor, failures: Counter[int]
) -> Generator[tuple[int, Result], None, bool]:
    """Run what is pending, once; what is done is taken out of it. Returns whether the executor broke."""
    try:
        futures = {executor.submit(function, task): index for index, task in pending.items()}
        for future in as_completed(futures):
            index = futures.pop(future)
            error = BrokenExecutor() if future.cancelled() else future.exception()
            if isinstance(error, BrokenExecutor):
                _LOGGER.warning("a worker died; %d tasks are tried again: %s", len(pending), _named(pending))
                return True  # the others of this round are lost too; a new executor takes them up
            if error is not None:
                failures[index] += 1
                _check(failures, error)
                _LOGGER.warning("task %d failed and is tried again: %s", index, error)
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
