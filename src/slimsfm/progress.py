"""Long work says how far it is: a function that takes `progress` wraps its loop in it.

`silent` is the default in the library, `shown` what the command line passes.
"""

from collections.abc import Iterator, Sequence
from typing import Protocol, TypeVar, runtime_checkable

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

Item = TypeVar("Item")


@runtime_checkable
class ProgressBar(Protocol):
    """Yields the items unchanged and may tell somebody about it."""

    def __call__(self, items: Sequence[Item], label: str) -> Iterator[Item]:
        """Iterate over items; `label` names the work."""
        ...


def silent(items: Sequence[Item], label: str) -> Iterator[Item]:  # noqa: ARG001
    """Tell nobody."""
    return iter(items)


def shown(items: Sequence[Item], label: str) -> Iterator[Item]:
    """Draw a bar with rate and time left on standard error."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        yield from bars.track(items, description=label)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.1f}/s" if task.speed else "")
