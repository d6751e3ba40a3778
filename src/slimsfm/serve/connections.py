"""Connections that do not end: uvicorn waits for ever for headers that come byte by byte; this does not."""

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

RECEIVE_S = 10.0
"""Longest time that the headers of a request may take."""

ANSWER_S = 60.0
"""Longest time from the headers of a request to the last byte of its answer."""

MOST_CONNECTIONS = 512
"""Largest number of open connections; further ones are closed at once."""

_LOOK_EVERY_S = 1.0


class TimedProtocol(H11Protocol):
    """HTTP/1.1 on a connection that is closed when it takes too long."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to measure time."""
        super().connection_made(transport)
        self._waiting_since, self._timed_cycle = self.loop.time(), None
        self._watch: asyncio.TimerHandle | None = None
        if len(self.connections) > MOST_CONNECTIONS:
            transport.abort()
            return
        self._watch = self.loop.call_later(_LOOK_EVERY_S, self._look)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop to measure."""
        self._stop_watching()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Leave the connection to the WebSocket, which has limits of its own."""
        self._stop_watching()
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        """Measure until the next request."""
        self._waiting_since = self.loop.time()
        super().on_response_complete()

    def _stop_watching(self) -> None:
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None

    def _look(self) -> None:
        now, cycle = self.loop.time(), self.cycle
        is_answering = cycle is not None and not cycle.response_complete
        if is_answering and cycle is not self._timed_cycle:
            self._timed_cycle, self._waiting_since = cycle, now
        if now - self._waiting_since > (ANSWER_S if is_answering else RECEIVE_S):
            self.transport.abort()
            return
        self._watch = self.loop.call_later(_LOOK_EVERY_S, self._look)
