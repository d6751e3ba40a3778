"""Progress of long work: a function that takes `progress` wraps its loop in it.

`silent` is the default in the library; the command line passes `shown`.
"""

import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from threading import Event, Thread
from time import perf_counter
from typing import Protocol, TypeVar, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

Item = TypeVar("Item")


@runtime_checkable
class ProgressBar(Protocol):
    """Yields the items of a loop unchanged and may show how far it is."""

    def __call__(self, items: Sequence[Item], label: str) -> Iterator[Item]:
        """Iterate over items; `label` names the work, as in "match pairs"."""
        ...


def silent(items: Sequence[Item], label: str) -> Iterator[Item]:  # noqa: ARG001
    """Show nothing."""
    return iter(items)


def shown(items: Sequence[Item], label: str) -> Iterator[Item]:
    """Show progress on standard error: a bar on a terminal, otherwise plain lines."""
    if len(items) == 0:
        return iter(items)
    bars = _terminal_bars()
    return bars(items, label) if bars.console.is_terminal else PlainLines()(items, label)


@contextmanager
def counted(progress: ProgressBar, total: int, label: str) -> Iterator[Callable[[int], None]]:
    """Show the progress of work that is not a Python loop.

    Yields:
        A function to call with the number of items done so far. A smaller number than before has no effect.
    """
    steps = progress(range(total), label)
    position = -1

    def advance_to(done: int) -> None:
        nonlocal position
        while position < min(done, total):
            next(steps, None)
            position += 1

    advance_to(0)
    try:
        yield advance_to
    finally:
        if isinstance(steps, Generator):
            steps.close()


@contextmanager
def single_step(progress: ProgressBar, label: str) -> Iterator[None]:
    """Show that work which cannot be counted begins and ends."""
    with counted(progress, 1, label) as advance_to:
        yield
        advance_to(1)


@dataclass(frozen=True)
class PlainLines:
    """Progress for logs: a line on standard error when a loop starts, when it ends, and at intervals."""

    interval_s: float = 30.0
    """Seconds between two lines inside a loop."""

    def __call__(self, items: Sequence[Item], label: str) -> Iterator[Item]:
        """Iterate over items."""
        loop = _Loop(label, len(items), perf_counter())
        ended = Event()
        reporter = Thread(target=self._report, args=(loop, ended), daemon=True)
        _write_line(loop.first_line())
        reporter.start()
        try:
            for item in items:
                yield item
                loop.done += 1
        finally:
            ended.set()
            reporter.join()
            _write_line(loop.last_line())

    def _report(self, loop: "_Loop", ended: Event) -> None:
        while not ended.wait(self.interval_s):
            _write_line(loop.line())


@dataclass
class _Loop:
    label: str
    total: int
    start_s: float
    done: int = 0

    def first_line(self) -> str:
        return f"{self.label}: started" if self.total == 1 else f"{self.label}: 0 of {self.total}"

    def line(self) -> str:
        seconds = perf_counter() - self.start_s
        if self.total == 1:
            return f"{self.label}: running for {seconds:.0f} s"
        if not self.done:
            return f"{self.label}: 0 of {self.total} after {seconds:.0f} s"
        rate = self.done / seconds
        left = (self.total - self.done) / rate
        return f"{self.label}: {self.done} of {self.total}, {rate:.2g}/s, {left:.0f} s left"

    def last_line(self) -> str:
        seconds = perf_counter() - self.start_s
        if self.total == 1:
            return f"{self.label}: {'done' if self.done else 'stopped'} after {seconds:.1f} s"
        return f"{self.label}: {self.done} of {self.total} in {seconds:.1f} s"


def _write_line(line: str) -> None:
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


class TerminalBars:
    """Progress for terminals: a bar per running loop, removed when the loop ends."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._running: Progress | None = None

    def __call__(self, items: Sequence[Item], label: str) -> Iterator[Item]:
        """Iterate over items."""
        if self._running is not None:  # a loop inside another one: its bar goes below
            yield from _with_bar(self._running, items, label)
            return
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            _Counts(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=self.console, transient=True) as self._running:
            try:
                yield from _with_bar(self._running, items, label)
            finally:
                self._running = None


def _with_bar(bars: Progress, items: Sequence[Item], label: str) -> Iterator[Item]:
    bar = bars.add_task(label, total=None if len(items) == 1 else len(items))
    try:
        for item in items:
            yield item
            bars.advance(bar)
    finally:
        bars.remove_task(bar)


class _Counts(ProgressColumn):
    """Items done and their rate; seconds for what cannot be counted."""

    def render(self, task: Task) -> Text:
        if task.total is None:
            return Text(f"{task.elapsed or 0:.0f} s")
        rate = f" {task.speed:.1f}/s" if task.speed else ""
        return Text(f"{task.completed:.0f}/{task.total:.0f}{rate}")


@cache
def _terminal_bars() -> TerminalBars:
    return TerminalBars(Console(stderr=True))
