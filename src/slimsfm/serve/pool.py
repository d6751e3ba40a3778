"""A fixed number of threads that work for clients in turn.

Work waits in a line per client, and the lines take turns: who sends much waits behind himself. What would not
be ready in time is refused before it waits.
"""

import asyncio
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from math import inf
from threading import Condition, Thread
from time import perf_counter
from typing import Any, TypeVar

from slimsfm.serve.errors import ApiError

T = TypeVar("T")

_NEWEST = 0.2  # weight of the last duration in the mean of its kind
_FIRST_GUESS_S = 0.05


@dataclass(eq=False, slots=True)
class _Job:
    work: Callable[[], Any]
    kind: str
    expected_s: float
    until: float  # perf_counter
    future: Future


class FairPool:
    """Threads that serve the lines of all clients in turn."""

    def __init__(self, workers: int, max_waiting: int) -> None:
        """Start the threads.

        Args:
            workers: Number of threads.
            max_waiting: Largest number of jobs that wait.
        """
        self._lines: OrderedDict[str, deque[_Job]] = OrderedDict()
        self._changed = Condition()
        self._max_waiting, self._waiting, self._running_s = max_waiting, 0, 0.0
        self._mean_s: dict[str, float] = {}
        self._closed = False
        self._threads = [
            Thread(target=self._serve, name=f"slimsfm-serve-{number}", daemon=True)
            for number in range(workers)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def waiting(self) -> int:
        """Number of jobs that wait."""
        return self._waiting

    async def run(self, client: str, kind: str, work: Callable[[], T], deadline_s: float | int = inf) -> T:
        """Run work on a thread when it is the client's turn.

        Args:
            client: Whose line it waits in.
            kind: Kind of work, whose mean duration predicts how long it takes.
            work: What to run. It is not begun if the caller is cancelled while it waits.
            deadline_s: Seconds from now after which nobody needs the result. Work without a deadline is never
                refused; a client must wait for it before it sends more.

        Raises:
            ApiError: The result would come too late, or too much waits already (503); or the deadline passed
                while it waited (504).
        """
        return await asyncio.wrap_future(self._submit(client, kind, work, deadline_s))

    def _submit(self, client: str, kind: str, work: Callable[[], T], deadline_s: float | int) -> "Future[T]":
        with self._changed:
            expected = self._mean_s.get(kind, _FIRST_GUESS_S)
            wait_s = self._predicted_wait_s(client)
            is_full = self._waiting >= self._max_waiting and deadline_s < inf
            if self._closed or is_full or wait_s + expected > deadline_s:
                raise ApiError(
                    503, "overloaded", "too much is waiting already; try again later", max(1.0, wait_s)
                )
            job = _Job(work, kind, expected, perf_counter() + deadline_s, Future())
            self._lines.setdefault(client, deque()).append(job)
            self._waiting += 1
            self._changed.notify()
        return job.future

    def _predicted_wait_s(self, client: str) -> float:
        """Seconds until a new job of a client begins, if all take as long as others of their kind did."""
        place = len(self._lines.get(client, ())) + 1
        ahead = sum(
            job.expected_s
            for other, line in self._lines.items()
            for job, _ in zip(line, range(place if other != client else place - 1), strict=False)
        )
        return (ahead + self._running_s) / len(self._threads)

    def _next(self) -> _Job | None:
        """The first job of the line whose turn it is; None once the pool is closed and nothing is left."""
        with self._changed:
            while not self._lines:
                if self._closed:
                    return None
                self._changed.wait()
            client, line = self._lines.popitem(last=False)
            job = line.popleft()
            if line:
                self._lines[client] = line  # at the end
            self._waiting -= 1
            self._running_s += job.expected_s
            return job

    def _serve(self) -> None:
        while job := self._next():
            start = perf_counter()
            ran = self._run(job)
            with self._changed:
                self._running_s -= job.expected_s
                if ran:
                    before, took = self._mean_s.get(job.kind, job.expected_s), perf_counter() - start
                    self._mean_s[job.kind] = before + _NEWEST * (took - before)

    @staticmethod
    def _run(job: _Job) -> bool:
        """Run a job unless nobody needs it any more; returns whether it ran."""
        if not job.future.set_running_or_notify_cancel():
            return False
        if perf_counter() > job.until:
            job.future.set_exception(ApiError(504, "too_late", "the request waited longer than its deadline"))
            return False
        try:
            result = job.work()
        except BaseException as error:
            job.future.set_exception(error)
        else:
            job.future.set_result(result)
        return True

    def close(self) -> None:
        """Take no more work, finish what there is, and end the threads."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
