"""The state of a track, the step from one frame to the next, and the smoothing of poses.

A frame is tracked in two stages. Coarse: optical flow follows the points seen in the last frame, starting
where constant velocity predicts them, and RANSAC finds the pose. Fine: all templates in sight from that pose
are searched for, and those found determine the final pose. The coarse stage copes with motion, but may follow
an object that passes in front. The fine stage compares with the first image of each point, so it neither
follows other objects nor drifts.
"""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from slimsfm.arrays import Points2D
from slimsfm.geometry import Box, corner_error, project
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose, refine_pose
from slimsfm.tracking.templates import FoundTemplates, GrayFrame, Templates, find_templates, follow_points

MAX_CORNER_ERROR = 0.03
"""Largest predicted corner error, over the diagonal, of an accepted pose: points on a small area, such as a
single label, agree equally well with two poses that differ by far more."""

_MIN_POINTS = 10  # that support a pose
_MIN_SHARE = 0.2  # of the points expected in sight that must be found
_MAX_ERROR_PX = 2.0  # of a point that supports a pose
_MAX_FLOW_ERROR_PX = 4.0  # of a point that supports the coarse pose
_ROUNDS = 3  # of searching templates, each from the pose of the last round
_SETTLED_PX = 1.0  # median motion of the points at which there is no further round
_STILL = 0.002  # corner error, over the diagonal, between poses of a still camera


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """An object in sight."""

    templates: Templates
    """Templates of the object's points."""

    frame: GrayFrame
    """The last frame."""

    pose: PoseEstimate
    """Pose of the last frame."""

    before_cam_from_world: pycolmap.Rigid3d | None
    """Pose of the frame before the last; None where it is unknown."""

    seen: FoundTemplates
    """Templates found in the last frame where its pose puts them."""


def begin_track(templates: Templates, points2D: Points2D, frame: GrayFrame, pose: PoseEstimate) -> Track:
    """Begin the track of an object that was just localized, with templates cut out of this frame."""
    rows = np.arange(len(templates))
    seen = FoundTemplates(rows=rows, points2D=points2D, num_expected=len(rows))
    return Track(templates=templates, frame=frame, pose=pose, before_cam_from_world=None, seen=seen)


def follow_track(track: Track, templates: Templates, frame: GrayFrame, box: Box) -> Track | None:
    """Find the object in the next frame.

    Args:
        track: The track up to the last frame.
        templates: Templates of the object's points; may be newer than those of the track.
        frame: The next frame, of the size of the last one.
        box: Box of the object.

    Returns:
        The track in the next frame, or None where the object is not found.
    """
    now, before = track.pose.cam_from_world, track.before_cam_from_world
    predicted = predicted_pose(now, before) if before else now
    for guess in (_pose_by_flow(track, frame, predicted), predicted):
        followed = guess and _pose_by_templates(templates, frame, guess, box)
        if followed:
            return replace(followed, before_cam_from_world=now)
    return None


def _pose_by_flow(track: Track, frame: GrayFrame, predicted: pycolmap.Rigid3d) -> pycolmap.Rigid3d | None:
    """The pose from the optical flow of the points seen last, or None."""
    points3D = track.templates.points3D_in_world[track.seen.rows]
    now, then = (project(points3D, pose, frame.camera) for pose in (predicted, track.pose.cam_from_world))
    flow = follow_points(track.frame.gray, frame.gray, track.seen.points2D, track.seen.points2D + now - then)
    search = RansacOptions(max_error_px=_MAX_FLOW_ERROR_PX, min_inliers=_MIN_POINTS)
    estimate = estimate_pose(flow.points2D[flow.found], points3D[flow.found], frame.camera, search)
    return estimate and estimate.cam_from_world


def _pose_by_templates(
    templates: Templates, frame: GrayFrame, guess: pycolmap.Rigid3d, box: Box, rounds: int = _ROUNDS
) -> Track | None:
    """The track whose pose the templates found near a guess agree on; None where too few do."""
    seen = find_templates(templates, frame, guess)
    if len(seen.rows) < max(_MIN_POINTS, _MIN_SHARE * seen.num_expected):
        return None
    points3D = templates.points3D_in_world[seen.rows]
    pose = refine_pose(seen.points2D, points3D, guess, frame.camera, max_error_px=_MAX_ERROR_PX)
    moved = project(points3D, pose.cam_from_world, frame.camera) - project(points3D, guess, frame.camera)
    if rounds > 1 and np.median(np.linalg.norm(moved, axis=1)) > _SETTLED_PX:
        return _pose_by_templates(templates, frame, pose.cam_from_world, box, rounds - 1)
    track = Track(templates=templates, frame=frame, pose=pose, before_cam_from_world=None, seen=seen)
    return _accepted(track, box)


def _accepted(track: Track, box: Box) -> Track | None:
    """The track without outliers; None unless enough points agree and determine the pose."""
    seen, agree = track.seen, track.pose.inliers
    enough = max(_MIN_POINTS, _MIN_SHARE * seen.num_expected, len(agree) / 2)
    if agree.sum() < enough or not track.pose.predicted_corner_error(box) <= MAX_CORNER_ERROR:
        return None
    inliers = FoundTemplates(
        rows=seen.rows[agree], points2D=seen.points2D[agree], num_expected=seen.num_expected
    )
    return replace(track, seen=inliers, pose=replace(track.pose, inliers=agree[agree]))


def predicted_pose(
    cam_from_world: pycolmap.Rigid3d, before_cam_from_world: pycolmap.Rigid3d
) -> pycolmap.Rigid3d:
    """The next pose at constant velocity: the last motion of the camera is repeated."""
    return cam_from_world * before_cam_from_world.inverse() * cam_from_world


def smoothed_pose(
    cam_from_world: pycolmap.Rigid3d, last_cam_from_world: pycolmap.Rigid3d, box: Box, strength: float
) -> pycolmap.Rigid3d:
    """Pull a pose toward the last smoothed one: strongly where they are close, hardly where they are not.

    Like the 1-euro filter [1], it removes the jitter of a still camera and does not lag behind a fast one.
    Poses of a still camera are averaged over about 1 + `strength` frames. Motion that moves the box's corners
    by n times the jitter is averaged over about 1 + `strength` / (1 + n^2) frames. The rotation follows the
    shortest arc, the center of the box a line in the camera's frame.

    Args:
        cam_from_world: Pose of this frame.
        last_cam_from_world: Smoothed pose of the last frame.
        box: Box of the object.
        strength: Frames to average over, minus one; 0 leaves the pose unchanged.

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
