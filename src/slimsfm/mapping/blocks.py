"""Independent tasks of a build, in this process or in workers, with results in order."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import TypeVar

import cv2
from threadpoolctl import threadpool_limits

from slimsfm.execution import OpenExecutor, run_tasks

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Who does the tasks of a build."""

    open_executor: OpenExecutor | None = None
    """Opens the executor; None: all tasks are done in this process."""

    min_seconds: float = 5.0
    """Expected duration from which tasks are given to the executor; fewer are done sooner in this process."""

    def in_order(
        self, function: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Generator[Result, None, None]:
        """Apply a function to every task and yield the results in the order of the tasks.

        The first task is done in this process, to predict how long the others would take here.

        Raises:
            WorkError: As `run_tasks`.
        """
        start = perf_counter()
        for task in tasks[:1]:
            yield function(task)
        seconds = (perf_counter() - start) * (len(tasks) - 1)
        open_executor = self.open_executor if seconds > self.min_seconds else None
        if open_executor:
            function = partial(_on_one_thread, function)
        waiting: dict[int, Result] = {}
        following = 0
        with closing(run_tasks(function, tasks[1:], open_executor)) as done:
            for index, result in done:
                waiting[index] = result
                while following in waiting:
                    yield waiting.pop(following)
                    following += 1


def _on_one_thread(function: Callable[[Task], Result], task: Task) -> Result:
    """Do a task without threads of OpenCV and of the matrix library: each core has a worker of its own."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            return function(task)
    finally:
        cv2.setNumThreads(before)
