"""How often a client may ask: a bucket of tokens per address."""

from collections import OrderedDict
from time import monotonic

from slimsfm.serve.errors import ApiError

_MOST_CLIENTS = 4096


class RateLimiter:
    """A bucket per client, which fills at a rate and holds a burst. For one event loop."""

    def __init__(self, per_second: float, burst: int) -> None:
        self._per_second, self._burst = per_second, float(burst)
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, client: str) -> None:
        """Take a token of a client.

        Raises:
            ApiError: There is none (429).
        """
        now = monotonic()
        left, since = self._left.pop(client, (self._burst, now))
        left = min(self._burst, left + (now - since) * self._per_second)
        taken = left >= 1
        self._left[client] = left - 1 if taken else left, now
        if len(self._left) > _MOST_CLIENTS:
            self._left.popitem(last=False)  # who was silent longest; his bucket is full most likely
        if not taken:
            wait_s = (1 - left) / self._per_second
            raise ApiError(429, "too_many_requests", "you send images too fast; wait a little", wait_s)
