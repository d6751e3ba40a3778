"""How poses go on from frame to frame: foretold by constant velocity, and smoothed."""

import numpy as np
import pycolmap

from slimsfm.geometry import Box, corner_error

_STILL = 0.002  # corner error, over the diagonal, up to which poses of a still camera tremble


def foretold(cam_from_world: pycolmap.Rigid3d, before_cam_from_world: pycolmap.Rigid3d) -> pycolmap.Rigid3d:
    """The next pose if the camera goes on as it did from the pose before to this one."""
    return cam_from_world * before_cam_from_world.inverse() * cam_from_world


def smoothed(
    cam_from_world: pycolmap.Rigid3d, last_cam_from_world: pycolmap.Rigid3d, box: Box, strength: float
) -> pycolmap.Rigid3d:
    """A pose drawn towards the last smoothed one: much where they are near, hardly where they are far apart.

    As the 1-euro filter [1] does, it takes the trembling out of a still picture and does not lag behind a
    fast one. A still camera's poses are averaged over about 1 + `strength` frames; what moves the box's
    corners by n times the trembling, over about 1 + `strength` / (1 + n^2). The rotation goes along the
    shortest turn, the box's centre along a line in the camera's frame.

    Args:
        cam_from_world: The pose of this frame.
        last_cam_from_world: What was given out for the last one.
        box: The object's box.
        strength: 0 leaves the pose as it is.

    References:
        [1] Casiez, Roussel and Vogel, 1 Euro Filter: A Simple Speed-based Low-pass Filter for Noisy Input in
            Interactive Systems, CHI 2012.
    """
    if strength == 0:
        return cam_from_world
    distance = corner_error(cam_from_world, last_cam_from_world, box) / _STILL
    share = 1 / (1 + strength / (1 + distance**2))
    turn = last_cam_from_world.rotation.inverse() * cam_from_world.rotation
    axis_angle = _axis_angle(turn)
    rotation = last_cam_from_world.rotation * pycolmap.Rotation3d(share * axis_angle)
    last_center, center = (pose * box.center[None] for pose in (last_cam_from_world, cam_from_world))
    goal = last_center + share * (center - last_center)
    turned = pycolmap.Rigid3d(rotation, np.zeros(3)) * box.center[None]
    return pycolmap.Rigid3d(rotation, (goal - turned)[0])


def _axis_angle(rotation: pycolmap.Rotation3d) -> np.ndarray:
    """Direction: the axis; length: the angle in radians, at most pi."""
    x, y, z, w = rotation.quat if rotation.quat[3] >= 0 else -rotation.quat
    sine = np.linalg.norm([x, y, z])
    return np.array([x, y, z]) * (2 * np.arctan2(sine, w) / sine if sine > 1e-12 else 2.0)
