"""How many clients are tracked at a time."""

import asyncio
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from slimsfm.serve.errors import ApiError


class Sessions:
    """The clients that are tracked, as many as the limits allow. For one event loop."""

    def __init__(self, most: int, most_of_one: int) -> None:
        """Set the limits: on all clients, and on those with one address."""
        self._most, self._most_of_one = most, most_of_one
        self._of: Counter[str] = Counter()
        self._awake: set[asyncio.Event] = set()
        self.ended = False
        """Whether the server stops."""

    @property
    def count(self) -> int:
        """Number of clients that are tracked."""
        return self._of.total()

    @contextmanager
    def admitted(self, client: str, wake: asyncio.Event) -> Iterator[None]:
        """Take a place for a client within the context.

        Args:
            client: Address of the client.
            wake: What to set when the server stops.

        Raises:
            ApiError: There is no place left (429).
        """
        if self.ended or self.count >= self._most or self._of[client] >= self._most_of_one:
            raise ApiError(429, "too_many_sessions", "too many clients are tracked already; try again later")
        self._of[client] += 1
        self._awake.add(wake)
        try:
            yield
        finally:
            self._awake.discard(wake)
            self._of[client] -= 1
            self._of += Counter()  # without addresses that left

    def end(self) -> None:
        """Let all sessions answer the frame at hand and then end."""
        self.ended = True
        for wake in self._awake:
            wake.set()
