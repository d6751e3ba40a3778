"""How much faster queries are with a reduced map, against both ways to match them with the full one."""

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from slimsfm.localization import LocalizationOptions, Localizer, Seconds
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images

_MOST_TESTS = 9
_SHARE_TESTED = 0.25  # of the images, at most


@dataclass(frozen=True, kw_only=True)
class Speed:
    """Median time of each stage of a query. That of extraction is the same; NaN if it is not known."""

    slim: Seconds
    """With the reduced map."""

    exhaustive: Seconds
    """With the full map, matched with all of its images."""

    default: Seconds
    """With the full map, matched by the strategy that `localize` uses by default."""

    strategy: str
    """Name of that strategy."""

    tests: int
    """Number of queries."""


def measure_speed(map: Map, slim: Map, extract_seconds: float = np.nan) -> Speed | None:
    """Localize some images of a map with a reduced one and, without these images, with the full one.

    The three ways take turns at each query, so that whatever else the machine does slows all of them. The
    images are localized by their features in the map.

    Args:
        map: The full map, with features.
        slim: A map that it was reduced to.
        extract_seconds: Time of extracting the features of an image; NaN if it is not known.

    Returns:
        The times; None if no image can be left out of both maps.
    """
    names = [name for name in map.images if slim.is_for_direct_matching or name not in slim.images]
    count = min(_MOST_TESTS, len(names), max(1, int(_SHARE_TESTED * len(map.images))))
    if not count or len(map.images) < 2:
        return None
    tests = [names[place] for place in np.linspace(0, len(names) - 1, count).round().astype(int)]
    full = keep_images(map, [name for name in map.images if name not in tests])
    default = LocalizationOptions()
    ways = (
        Localizer(slim, default),
        Localizer(full, LocalizationOptions(strategy="exhaustive")),
        Localizer(full, default),
    )
    with threadpool_limits(1):
        _seconds(ways, map, tests[0])  # the first query also pays for what is only done once
        medians = np.median([_seconds(ways, map, name) for name in tests], axis=0).tolist()
    slim_seconds, exhaustive, usual = (
        Seconds(extract=extract_seconds, match=match, pose=pose) for match, pose in medians
    )
    return Speed(
        slim=slim_seconds,
        exhaustive=exhaustive,
        default=usual,
        strategy=default.strategy_for(full),
        tests=count,
    )


def _seconds(ways: tuple[Localizer, ...], map: Map, name: str) -> list[tuple[float, float]]:
    """Times of matching and pose of an image with each localizer."""
    found = [one.localize_features(map.features[name], map.camera(name)).seconds for one in ways]
    return [(one.match, one.pose) for one in found]
