"""How much of each object the page shows, so that one of many objects still opens."""

from dataclasses import dataclass
from math import sqrt

_GENEROUS = 6  # objects, each of which is shown in full
_PHOTO_BYTES = 600_000  # of all photos of one reference graph
_BYTES_PER_PX = 0.5  # of a JPEG as small as these, and as text
_MOST_PHOTO_PX, _LEAST_PHOTO_PX = 160, 40


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Limits for one object."""

    points: int
    """3D points of each map."""

    frames: int
    """Query images."""

    frame_px: int
    """Longer side of a query image."""

    photo_px: int
    """Longer side of a reference photo; 0: just those of the dominating set are shown, as small as can be."""


def budget_for(objects: int, references: int) -> Budget:
    """The limits for each of so many objects, with so many reference images."""
    share = min(1.0, _GENEROUS / objects)
    pixels = share * _PHOTO_BYTES / (references * _BYTES_PER_PX)
    side = round(sqrt(pixels * 4 / 3))
    return Budget(
        points=max(1000, round(15_000 * share)),
        frames=max(2, round(6 * share)),
        frame_px=max(240, round(480 * sqrt(share))),
        photo_px=min(_MOST_PHOTO_PX, side) if side >= _LEAST_PHOTO_PX else 0,
    )
