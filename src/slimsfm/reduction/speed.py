"""How much faster queries are with a reduced map, against both ways to match them with the full one."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from slimsfm.arrays import evenly_spaced
from slimsfm.localization import LocalizationOptions, Localizer, Seconds
from slimsfm.localization.cameras import QueryCamera
from slimsfm.localization.rounds import StoredRounds
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.reduction.extraction_time import extraction_if_known

_MOST_TESTS = 9
_SHARE_TESTED = 0.25  # of the images, at most


@dataclass(frozen=True, kw_only=True)
class Speed:
    """Median time of each stage of a query; that of extraction is NaN if it is not known."""

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


def measure_speed(map: Map, slim: Map) -> Speed | None:
    """Localize some images of a map with a reduced one and, without these images, with the full one.

    The three ways take turns at each query, so that whatever else the machine does slows all of them. The
    images are localized by their features in the map: those that a shrunken image has, and more if they do
    not suffice, as `localize` does it. The time of extraction is what such an image would take here.

    Args:
        map: The full map, with features.
        slim: A map that it was reduced to.

    Returns:
        The times; None if no image can be left out of both maps.
    """
    names = [name for name in map.images if slim.is_for_direct_matching or name not in slim.images]
    count = min(_MOST_TESTS, len(names), max(1, int(_SHARE_TESTED * len(map.images))))
    if not count or len(map.images) < 2:
        return None
    tests = [names[place] for place in evenly_spaced(len(names), count)]
    full = keep_images(map, [name for name in map.images if name not in tests])
    default = LocalizationOptions()
    ways = (
        Localizer(slim, default),
        Localizer(full, LocalizationOptions(strategy="exhaustive", extraction="whole")),
        Localizer(full, default),
    )
    with threadpool_limits(1):
        _seconds(ways, map, tests[0])  # the first query also pays for what is only done once
        medians = np.median([_seconds(ways, map, name) for name in tests], axis=0).tolist()
    slim_seconds, exhaustive, usual = (
        Seconds(extract=extract, match=match, pose=pose) for extract, match, pose in medians
    )
    return Speed(
        slim=slim_seconds,
        exhaustive=exhaustive,
        default=usual,
        strategy=default.strategy_for(full),
        tests=count,
    )


def _seconds(ways: tuple[Localizer, ...], map: Map, name: str) -> list[tuple[float, float, float]]:
    """Time of each stage of an image with each localizer."""
    camera, times = QueryCamera(camera=map.camera(name), source="map"), []
    for one in ways:
        source = StoredRounds(map.features[name], partial(extraction_if_known, map))
        found = one.localize_in_rounds(source, camera).seconds
        times.append((found.extract, found.match, found.pose))
    return times
