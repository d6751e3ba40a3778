"""Points on known rays: their depths by least squares over the reprojection errors.

A point that is fixed to the ray of one of its observations has one unknown. So the normal equations of all
points together are diagonal, and Levenberg's and Marquardt's method runs for all at once, each point with a
damping of its own.
"""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Ids, Points2D, Points3D

_STEPS = 50  # of Levenberg and Marquardt; 4 to 6 are common
_CONVERGED = 1e-12  # of the depth: a step below changes nothing
_DERIVATIVE = 1e-6  # step of the numerical derivative, relative to depth
_MOST_DAMPING = 1e12

Depths = Float64[np.ndarray, " m"]
"""Depths of points in the cameras whose rays they are on, along the optical axis, in map units."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sightings:
    """Observations of points that lie on rays: point p is at `origins + depth[p] * directions`."""

    points: Ids
    """For each observation the point, a row of the depths."""

    origins_in_cam: Points3D
    """Where the point's ray starts, in the frame of the observing camera."""

    directions_in_cam: Points3D
    """Where it goes, in the same frame; 1 long along the optical axis of the camera that it starts from."""

    points2D: Points2D
    """Pixels where the point was seen."""

    cameras: tuple[pycolmap.Camera, ...]
    """The intrinsics."""

    camera_rows: Ids
    """For each observation its camera."""

    def __getitem__(self, rows: Ids) -> "Sightings":
        """Some of them."""
        return replace(
            self,
            points=self.points[rows],
            origins_in_cam=self.origins_in_cam[rows],
            directions_in_cam=self.directions_in_cam[rows],
            points2D=self.points2D[rows],
            camera_rows=self.camera_rows[rows],
        )

    def residuals(self, depths: Depths) -> Float64[np.ndarray, "n 2"]:
        """How many pixels points project from where they were seen; infinite where they do not project."""
        points3D_in_cam = self.origins_in_cam + depths[self.points, None] * self.directions_in_cam
        pixels = np.full(self.points2D.shape, np.inf)
        for row, camera in enumerate(self.cameras):
            mine = self.camera_rows == row
            pixels[mine] = camera.img_from_cam(points3D_in_cam[mine])
        pixels[np.isnan(pixels)] = np.inf
        return pixels - self.points2D

    def errors(self, depths: Depths) -> Float64[np.ndarray, " n"]:
        """Distances in pixels between where points project and where they were seen."""
        return np.linalg.norm(self.residuals(depths), axis=1)


def refine_depths(sightings: Sightings, depths: Depths) -> Depths:
    """Move each point along its ray to where the sum of its squared reprojection errors is least.

    Exact in the lens, its derivative numerical. O(observations) a step; points do not influence each other.

    Args:
        sightings: What is seen of the points, beside the observations whose rays they are on.
        depths: Where to start.
    """
    damping = np.full(len(depths), 1e-3)
    costs = _sums(sightings, _squares(sightings.residuals(depths)), len(depths))
    active = np.isfinite(costs)
    for _ in range(_STEPS):
        if not active.any():
            break
        steps = np.where(active, _steps(sightings, depths, damping), 0.0)
        moved = depths + steps
        moved_costs = _sums(sightings, _squares(sightings.residuals(moved)), len(depths))
        better = active & (moved > 0) & (moved_costs <= costs)
        depths, costs = np.where(better, moved, depths), np.where(better, moved_costs, costs)
        damping = np.where(better, np.maximum(damping / 10, 1e-12), damping * 10)
        active &= (np.abs(steps) > _CONVERGED * depths) & (damping < _MOST_DAMPING)
    return depths


def _steps(sightings: Sightings, depths: Depths, damping: Depths) -> Depths:
    widths = _DERIVATIVE * depths
    ahead, behind = (sightings.residuals(depths + sign * widths) for sign in (1, -1))
    with np.errstate(invalid="ignore"):
        jacobian = (ahead - behind) / (2 * widths[sightings.points, None])
        products = np.sum(jacobian * sightings.residuals(depths), axis=1)
    gradients = _sums(sightings, products, len(depths))
    curvatures = _sums(sightings, _squares(jacobian), len(depths)) * (1 + damping)
    known = np.isfinite(gradients) & (curvatures > 0)
    return np.where(known, -gradients / np.where(known, curvatures, 1), 0.0)


def _squares(residuals: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
    return np.sum(residuals**2, axis=1)


def _sums(sightings: Sightings, values: Float64[np.ndarray, " n"], count: int) -> Depths:
    return np.bincount(sightings.points, weights=values, minlength=count).astype(np.float64)
