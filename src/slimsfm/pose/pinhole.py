"""The ideal pinhole camera that PoseLib's solvers take, and the conversion of poses to and from PoseLib."""

from dataclasses import dataclass

import numpy as np
import poselib
import pycolmap

from slimsfm.arrays import Ids, Points2D, Points3D


def check_matches(points2D: Points2D, points3D_in_world: Points3D) -> None:
    """Check that points correspond row by row and are finite.

    Raises:
        ValueError: The numbers of rows differ, or a coordinate is not finite.
    """
    if len(points2D) != len(points3D_in_world):
        raise ValueError(
            f"points2D and points3D_in_world must match row by row, got {len(points2D)} and "
            f"{len(points3D_in_world)} rows"
        )
    for name, points in (("points2D", points2D), ("points3D_in_world", points3D_in_world)):
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise ValueError(f"{name} must be finite, got {points[bad[0]].tolist()} in row {bad[0]}")


def check_has_focal_length(camera: pycolmap.Camera) -> None:
    """Check that the camera is not spherical.

    Raises:
        ValueError: The camera is spherical and has no focal length, which a pinhole solver needs.
    """
    if camera.is_spherical():
        raise ValueError(f"camera must have a focal length, got the spherical model {camera.model_name}")


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeMatches:
    """Matches of the ideal pinhole camera that has the focal length of a given camera."""

    rows: Ids
    """Rows of the given matches; pixels that no ray in front of the camera reaches are left out."""

    pixels: Points2D
    """Undistorted pixels; the principal point is (0, 0)."""

    in_world: Points3D
    """The point matched with each pixel."""

    pinhole: dict
    """PoseLib's description of the ideal camera."""

    @classmethod
    def of(cls, points2D: Points2D, points3D_in_world: Points3D, camera: pycolmap.Camera) -> "PinholeMatches":
        """Undistort the pixels of matches."""
        focal_px = camera.mean_focal_length()
        pixels = focal_px * np.asarray(camera.cam_from_img(points2D), dtype=np.float64).reshape(-1, 2)
        rows = np.flatnonzero(np.isfinite(pixels).all(axis=1))
        return cls(
            rows=rows,
            pixels=pixels[rows],
            in_world=points3D_in_world[rows],
            pinhole={
                "model": "SIMPLE_PINHOLE",
                "width": camera.width,
                "height": camera.height,
                "params": [focal_px, 0.0, 0.0],
            },
        )

    @property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return self.pinhole["params"][0]


def to_poselib(cam_from_world: pycolmap.Rigid3d) -> poselib.CameraPose:
    """Convert a pose to PoseLib, whose quaternions begin with w."""
    x, y, z, w = cam_from_world.rotation.quat
    pose = poselib.CameraPose()
    pose.q, pose.t = np.array([w, x, y, z]), cam_from_world.translation
    return pose


def from_poselib(pose: poselib.CameraPose) -> pycolmap.Rigid3d:
    """Convert a pose from PoseLib."""
    w, x, y, z = pose.q
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), pose.t)
