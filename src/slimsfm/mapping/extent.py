"""Whether coordinates can be those of a real place, in any unit."""

import numpy as np

from slimsfm.arrays import Points3D
from slimsfm.geometry import Box

_FARTHEST = 1e15  # units from the origin: beyond, differences are lost, and later squares overflow
_SMALLEST = 1e-12  # extent, in units and over the distance from the origin
_FARTHEST_BOX = 1e3  # from the points, over the sizes of both
_MOST_UNLIKE = 1e6  # ratio of the sizes of box and map


def distance_fault(name: str, positions: Points3D) -> str | None:
    """What is impossible about how far positions are from the origin, or None."""
    farthest = np.abs(positions).max(initial=0)
    if farthest < _FARTHEST:
        return None
    return f"its {name} are up to {farthest:g} units from the origin, too far to compute with"


def extent_fault(name: str, positions: Points3D) -> str | None:
    """What is impossible about how far positions are from the origin and from each other, or None."""
    if fault := distance_fault(name, positions):
        return fault
    least = _SMALLEST * max(1.0, np.abs(positions).max(initial=0))
    if len(positions) < 2 or np.ptp(positions, axis=0).max() > least:
        return None
    return f"its {len(positions)} {name} are all in one place"


def box_fault(box: Box, points3D_in_world: Points3D) -> str | None:
    """What is impossible about the box of a map, or None."""
    if fault := extent_fault("corners of the box", box.corners):
        return fault
    center = np.median(points3D_in_world, axis=0)
    size = float(np.median(np.linalg.norm(points3D_in_world - center, axis=1)))
    away = float(np.linalg.norm(box.center - center))
    if away > _FARTHEST_BOX * max(size, box.diagonal):
        return f"its box is {away:g} units from its points, which are about {size:g} from their center"
    if size / _MOST_UNLIKE <= box.diagonal and (size <= 0 or box.diagonal <= size * _MOST_UNLIKE):
        return None
    return f"its box has a diagonal of {box.diagonal:g}, but the points are about {size:g} from their center"
