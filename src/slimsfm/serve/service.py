"""What the handlers of a server share."""

import asyncio
import json
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

from slimsfm.mapping.map import Map
from slimsfm.serve.maps import MapStore, map_ids
from slimsfm.serve.metrics import Metrics, resident_bytes
from slimsfm.serve.models import read_anchor, read_model
from slimsfm.serve.options import ServeOptions
from slimsfm.serve.pool import FairPool
from slimsfm.serve.rate import RateLimiter
from slimsfm.serve.recorder import Recorder
from slimsfm.serve.sessions import Sessions

_LOGGER = logging.getLogger(__name__)


class Service:
    """Maps, workers and limits of a server.

    Attributes:
        options: What is served and to whom.
        store: The maps.
        pool: The threads that localize and track.
        sessions: The clients that are tracked.
        rate: How often clients may ask.
        metrics: Counters.
        recorder: What is kept of images.
    """

    def __init__(self, options: ServeOptions) -> None:
        """Read the maps and start the workers.

        Raises:
            InputError: A map cannot be read.
        """
        limits = options.limits
        self.options = options
        self.store = MapStore(options.maps, options.localization, _models(options))
        self.recorder = Recorder(options.record)
        self.pool = FairPool(limits.workers, limits.max_waiting)
        self.sessions = Sessions(limits.max_sessions, limits.sessions_per_client)
        self.rate = RateLimiter(limits.requests_per_second, limits.burst)
        self.metrics = Metrics()

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Look for replaced maps within the context; at its end finish what runs."""
        watching = asyncio.create_task(self._watch())
        try:
            yield
        finally:
            watching.cancel()
            with suppress(asyncio.CancelledError):
                await watching
            self.sessions.end()
            await asyncio.to_thread(self.pool.close)

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(self.options.limits.reload_every_s)
            try:
                for key in await asyncio.to_thread(self.store.reload_changed):
                    _LOGGER.info("%s: version %s is served", key, self.store[key].version)
            except Exception:
                _LOGGER.exception("looking for replaced maps failed")

    def metrics_text(self) -> str:
        """All metrics in Prometheus' text format."""
        return self.metrics.text(
            sessions=self.sessions.count,
            waiting=self.pool.waiting,
            map_loads_total=self.store.loads,
            resident_memory_bytes=resident_bytes(),
        )


def _models(options: ServeOptions) -> Callable[[str, Map], bytes | None]:
    """What gives the model of a map; the first map alone has one."""
    if options.model is None:
        return lambda _id, _map: None
    path, anchor = options.model, read_anchor(options.anchor) if options.anchor else None
    first = map_ids(options.maps)[0]

    def model_for(map_id: str, map: Map) -> bytes | None:
        return json.dumps(read_model(path, map.box, anchor).to_json()).encode() if map_id == first else None

    return model_for
