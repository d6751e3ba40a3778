"""Boxes, projection, and distances between poses.

A pose is a `pycolmap.Rigid3d` called `cam_from_world`: `x_in_cam = R @ x_in_world + t`.
"""

from copy import copy
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points2D, Points3D

_SIGNS = np.array(list(product((-1.0, 1.0), repeat=3)))

ADD_FRACTIONS = (0.1, 0.05, 0.02)
"""Thresholds, as fractions of the diagonal, of ADD-0.1d and its stricter variants."""

BOX_EDGES = tuple((i, j) for i, j in combinations(range(8), 2) if np.sum(_SIGNS[i] != _SIGNS[j]) == 1)
"""Pairs of corners of a `Box` joined by its twelve edges."""


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented 3D box around an object.

    Corner k is `center` plus or minus each half edge; the signs are the binary digits of k, first edge first.
    """

    center: Float64[np.ndarray, "3"]
    """Center, in the frame and unit of the map."""

    half_edges: Float64[np.ndarray, "3 3"]
    """Row i points from the center of the box to the center of the i-th face."""

    def __post_init__(self) -> None:
        values = np.concatenate([self.center, self.half_edges.ravel()])
        if not np.all(np.isfinite(values)) or self.diagonal <= 0:
            raise ValueError(f"half_edges must be finite and not all zero, got {self.half_edges.tolist()}")

    @property
    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """The eight corners, in the frame and unit of the map."""
        return self.center + _SIGNS @ self.half_edges

    @property
    def diagonal(self) -> float:
        """Length of the longest diagonal: the `d` of every relative error."""
        return float(2 * np.linalg.norm(_SIGNS[:4] @ self.half_edges, axis=1).max())

    @classmethod
    def from_corners(cls, corners: Points3D) -> "Box":
        """Find the box with the given corners, in any order.

        Raises:
            ValueError: There are not 8 corners, or they do not form a box (within 1 % of its diagonal).
        """
        if corners.shape != (8, 3):
            raise ValueError(f"corners must be 8 points with 3 coordinates, got shape {corners.shape}")
        center = corners.mean(axis=0)
        candidates = [
            cls(center, np.array([(corners[k] - corners[0]) / 2 for k in others]))
            for others in combinations(range(1, 8), 3)
        ]
        gaps = [_hausdorff(box.corners, corners) for box in candidates]
        best = candidates[int(np.argmin(gaps))]
        if not min(gaps) < 0.01 * best.diagonal:
            raise ValueError("corners must be the 8 corners of a box, but no three edges span these points")
        return best


def _hausdorff(a: Points3D, b: Points3D) -> float:
    distances = np.linalg.norm(a[:, None] - b[None], axis=2)
    return float(max(distances.min(axis=0).max(), distances.min(axis=1).max()))


def project(
    points3D_in_world: Points3D, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera
) -> Float64[np.ndarray, "n 2"]:
    """Project points into an image with the camera's distortion; NaN where a point does not project.

    Points that are not in front of the camera do not, whatever the formulas of its model give.
    """
    in_cam = cam_from_world * points3D_in_world
    pixels = np.asarray(camera.img_from_cam(in_cam), dtype=np.float64).reshape(-1, 2)
    pixels[in_cam[:, 2] <= 0] = np.nan
    return pixels


def reprojection_errors(
    points2D: Points2D,
    points3D_in_world: Points3D,
    cam_from_world: pycolmap.Rigid3d,
    camera: pycolmap.Camera,
) -> Float64[np.ndarray, " n"]:
    """Distances in pixels between points and their projected 3D points; infinite where there is none."""
    errors = np.linalg.norm(project(points3D_in_world, cam_from_world, camera) - points2D, axis=1)
    return np.where(np.isfinite(errors), errors, np.inf)


def resized_camera(camera: pycolmap.Camera, factor: float | int) -> pycolmap.Camera:
    """The camera of an image whose sides are multiplied by a factor."""
    resized, params = copy(camera), camera.params.copy()
    params[[*camera.focal_length_idxs(), *camera.principal_point_idxs()]] *= factor
    resized.params = params.tolist()
    resized.width, resized.height = (max(1, round(side * factor)) for side in (camera.width, camera.height))
    return resized


def motions(points3D_in_cam: Points3D) -> Float64[np.ndarray, "n 3 6"]:
    """Derivative of points in the camera's frame with respect to a motion of the points.

    The first three columns are for a rotation in radians, the last three for a translation.
    """
    x, y, z = points3D_in_cam.T
    moved = np.zeros((len(points3D_in_cam), 3, 6))
    moved[:, 0, 1], moved[:, 0, 2] = z, -y
    moved[:, 1, 0], moved[:, 1, 2] = -z, x
    moved[:, 2, 0], moved[:, 2, 1] = y, -x
    moved[:, [0, 1, 2], [3, 4, 5]] = 1
    return moved


def corner_error(a_cam_from_world: pycolmap.Rigid3d, b_cam_from_world: pycolmap.Rigid3d, box: Box) -> float:
    """Mean distance between the corners of the box under two poses, over its diagonal."""
    corners = box.corners
    distances = np.linalg.norm(a_cam_from_world * corners - b_cam_from_world * corners, axis=1)
    return float(distances.mean() / box.diagonal)


def rotation_error_deg(a_cam_from_world: pycolmap.Rigid3d, b_cam_from_world: pycolmap.Rigid3d) -> float:
    """Angle of the rotation between two poses, in [0, 180].

    It is the angle of a unit quaternion, which is accurate near 0 and 180 degrees, unlike the arc cosine of
    the trace.
    """
    x, y, z, w = (a_cam_from_world.rotation.inverse() * b_cam_from_world.rotation).quat
    return float(np.degrees(2 * np.arctan2(np.linalg.norm([x, y, z]), abs(w))))


def translation_error(a_cam_from_world: pycolmap.Rigid3d, b_cam_from_world: pycolmap.Rigid3d) -> float:
    """Distance, in map units, between the positions of the world's origin in the two cameras' frames."""
    return float(np.linalg.norm(a_cam_from_world.translation - b_cam_from_world.translation))
