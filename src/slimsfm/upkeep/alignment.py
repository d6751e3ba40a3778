"""What aligning a map found."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.mapping.georeference import Georeference
from slimsfm.mapping.map import Map
from slimsfm.upkeep.transform import transformed


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """A map in its new frame, and what that rests on."""

    map: Map
    """The aligned map."""

    new_from_old: pycolmap.Sim3d
    """From the frame of the given map to that of the new one."""

    by: str
    """What it was aligned by: "20 known positions"."""

    used: int
    """Number of these that could be used."""

    inliers: int
    """Number of those that agree with the result."""

    outliers: tuple[str, ...] = ()
    """Names of those that do not."""

    residuals: Float64[np.ndarray, " n"]
    """Errors of those that agree, in `residual_unit`; empty where nothing is left to check."""

    residual_unit: str
    """"m", "px", "°" or "map units"."""

    scale_bound: float | None = None
    """Relative error of the scale that 95 % stay below; None if the scale stays as it was."""

    turn_bound_deg: float | None = None
    """Error of the rotation, about its least certain axis, that 95 % stay below; None if it stays."""

    heading_bound_deg: float | None = None
    """The same about the axis that is up; None if the heading stays or is unknown."""

    notes: tuple[str, ...] = ()
    """Sentences, with names, on what was left out."""

    @property
    def median_residual(self) -> float | None:
        """Median of `residuals`; None if there are none."""
        return float(np.median(self.residuals)) if len(self.residuals) else None

    @property
    def max_residual(self) -> float | None:
        """Largest of `residuals`; None if there are none."""
        return float(np.max(self.residuals)) if len(self.residuals) else None


def in_new_frame(
    map: Map, new_from_old: pycolmap.Sim3d, by: str, *, unit: str, georeference: Georeference | None
) -> Map:
    """Move a map, and say what its new frame is and where it comes from."""
    moved = transformed(map, new_from_old)
    origin = f"{map.info.origin}; aligned by {by}"
    return replace(moved, info=replace(moved.info, unit=unit, georeference=georeference, origin=origin))
