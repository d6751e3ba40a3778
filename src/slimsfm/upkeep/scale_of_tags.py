"""The scale of a map by all tags of one size, which must agree."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from slimsfm.errors import InputError
from slimsfm.mapping.map import Map
from slimsfm.upkeep.tag_size import TagSize, measure_tag
from slimsfm.upkeep.tags import TagView

_TOLERANCE, _SIGMAS = 0.02, 4.0  # of two sizes, and in standard deviations of their ratio
_BETWEEN_TAGS = 0.002  # accuracy of a print, and of the map from place to place


@dataclass(frozen=True, kw_only=True, eq=False)
class TagScale:
    """The scale by tags."""

    scale: float
    """Meters per map unit."""

    relative_bound: float
    """Error that 95 % stay below."""

    tags: tuple[TagSize, ...]
    """The tags that it is computed from."""

    notes: tuple[str, ...]
    """Sentences on tags that were left out."""


def scale_of_tags(map: Map, views: dict[int, list[TagView]], side: float, number: int | None) -> TagScale:
    """Find the scale at which all tags have the same side; better determined tags count more.

    Args:
        map: The map.
        views: The views of each tag.
        side: Side of each in meters.
        number: The tag to use; all if None.

    Raises:
        InputError: The tag is not there, no tag is determined, or two give different scales.
    """
    if number is not None and number not in views:
        found = ", ".join(str(one) for one in views)
        raise InputError(f"the photos do not show tag {number}, but {found}; name one of these")
    chosen = views if number is None else {number: views[number]}
    tags, failures = [], []
    for one, seen in chosen.items():
        try:
            tags.append(measure_tag(map, one, seen))
        except InputError as error:
            failures.append(str(error))
    if not tags:
        others = f" (and {len(failures) - 1} other tags)" if len(failures) > 1 else ""
        raise InputError(failures[0] + others)
    _check_equal(tags, side)
    weights = np.array([1 / (tag.relative_sigma**2 + _BETWEEN_TAGS**2) for tag in tags])
    log_side = float(weights @ np.log([tag.side for tag in tags]) / weights.sum())
    return TagScale(
        scale=side / float(np.exp(log_side)),
        relative_bound=float(2 / np.sqrt(weights.sum())),
        tags=tuple(tags),
        notes=tuple(f"left out: {failure}" for failure in failures),
    )


def _check_equal(tags: list[TagSize], side: float) -> None:
    for one, other in combinations(tags, 2):
        ratio = one.side / other.side
        spread = np.hypot(one.relative_sigma, other.relative_sigma)
        if abs(np.log(ratio)) > max(_TOLERANCE, _SIGMAS * spread):
            raise InputError(
                f"tags {one.number} and {other.number} contradict each other: if both have sides of {side:g} "
                f"m, they give scales that differ by a factor of {max(ratio, 1 / ratio):.3g}; give the "
                "number of the one that has this side"
            )
