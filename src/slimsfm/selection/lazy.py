"""Lazy greedy maximization [1]: gains never rise, so an earlier gain bounds the current one from above.

References:
    [1] Minoux, Accelerated greedy algorithms for maximizing submodular set functions, 1978.
"""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float64, Int64

from slimsfm.arrays import Ids, Mask

Gains = Float64[np.ndarray, " n"]
Some = Int64[np.ndarray, " m"]

_NEGLIGIBLE = 1e-9
_FRONT = 4096  # items with the largest bounds, among which the best is searched; at least a share of all
_SHARE = 64
_BATCH = 32  # gains evaluated at once; doubled each time that they do not decide


def greedy_order(first_gains: Gains, gains: Callable[[Ids], Gains], allowed: Mask) -> Iterator[int]:
    """Yield the item of the largest gain repeatedly, until no item has a gain.

    Args:
        first_gains: Upper bounds of the gains.
        gains: The current gains of items; they must not rise when items are chosen.
        allowed: Which items may be chosen.

    Notes:
        The caller must apply the choice of an item before it requests the next one. Ties go to the lower
        index. Bounds are kept for all items but searched only among the largest, some thousands, until those
        have fallen below the rest; gains are evaluated in batches, at most about twice as many as in [1].
    """
    bounds = np.where(allowed, first_gains, 0.0)
    while bounds.max(initial=0.0) > _NEGLIGIBLE:
        front, rest = _largest(bounds)
        yield from _from_front(bounds, front, rest, gains)


def _largest(bounds: Gains) -> tuple[Some, int | None]:
    """The items of the largest bounds, ascending, and the best of the rest; ties are broken by index."""
    size = max(_FRONT, len(bounds) // _SHARE)
    if len(bounds) <= size:
        return np.arange(len(bounds)), None
    last = -np.partition(-bounds, size)[size]
    above, equal = np.flatnonzero(bounds > last), np.flatnonzero(bounds == last)
    room = size - len(above)
    return np.sort(np.concatenate([above, equal[:room]])), int(equal[room])


def _from_front(bounds: Gains, front: Some, rest: int | None, gains: Callable[[Ids], Gains]) -> Iterator[int]:
    """Yield the best items as long as they lie in the front, then bring its bounds up to date."""
    values = bounds[front]
    fresh, size = np.zeros(len(front), bool), _BATCH
    while True:
        place = int(values.argmax())
        if values[place] <= _NEGLIGIBLE or _is_better(rest, bounds, int(front[place]), float(values[place])):
            break
        if fresh[place]:
            values[place] = 0.0
            yield int(front[place])
            fresh[:], size = False, _BATCH
        else:
            batch = _stale(values, fresh, size)
            values[batch] = gains(front[batch])
            fresh[batch] = True
            size *= 2
    bounds[front] = values


def _is_better(rest: int | None, bounds: Gains, item: int, gain: float) -> bool:
    """Whether the best of the rest, if there is any, comes before an item of this gain."""
    return rest is not None and (-float(bounds[rest]), rest) < (-gain, item)


def _stale(bounds: Gains, fresh: Mask, size: int) -> Some:
    """Up to `size` places of the largest bounds that are not fresh but may be above all that are."""
    stale = np.flatnonzero(~fresh & (bounds >= bounds[fresh].max(initial=_NEGLIGIBLE)))
    if len(stale) <= size:
        return stale
    return stale[np.argpartition(-bounds[stale], size)[:size]]
