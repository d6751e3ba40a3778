"""What is carried from frame to frame, and how one frame leads to the next.

A frame is followed in two steps. Coarse: optical flow carries the points seen in the last frame, from where
constant velocity puts them, and RANSAC finds the pose that most agree on. Fine: all templates in sight from
there are sought, and those found decide the pose. The coarse step copes with motion, but may stick to what
passes in front; the fine one compares with the first picture of each point, and so neither sticks nor drifts.
"""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from slimsfm.arrays import Points2D
from slimsfm.geometry import Box, project
from slimsfm.pose import PoseEstimate, RansacOptions, estimate_pose, refine_pose
from slimsfm.tracking.flow import follow_points
from slimsfm.tracking.gray_frame import View
from slimsfm.tracking.motion import foretold
from slimsfm.tracking.templates import Sighting, Templates, find

MAX_CORNER_ERROR = 0.03
"""Largest corner error, over the diagonal, to expect of a pose that is believed: points on a small spot, such
as a lone label, fit two poses equally well that differ by far more."""

_MIN_POINTS = 10  # that a pose may rest on
_MIN_SHARE = 0.2  # of the points that should be in sight those that must be
_MAX_ERROR_PX = 2.0  # of a point that bears out a pose
_MAX_FLOW_ERROR_PX = 4.0  # of a point that helps to guess one
_ROUNDS = 3  # of seeking templates, each from the pose that the last one gave
_SETTLED_PX = 1.0  # median motion of the points at which there is no next round


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """An object in sight."""

    templates: Templates
    """What is known of the object's looks."""

    view: View
    """The last frame."""

    pose: PoseEstimate
    """Its pose."""

    before_cam_from_world: pycolmap.Rigid3d | None
    """The pose of the frame before; None where it is unknown."""

    seen: Sighting
    """The templates that the last frame shows where its pose puts them."""


def begun(templates: Templates, points2D: Points2D, view: View, pose: PoseEstimate) -> Track:
    """The track of an object that was just localized, all its templates cut out of this frame."""
    rows = np.arange(len(templates))
    seen = Sighting(rows=rows, points2D=points2D, num_expected=len(rows))
    return Track(templates=templates, view=view, pose=pose, before_cam_from_world=None, seen=seen)


def follow(track: Track, templates: Templates, view: View, box: Box) -> Track | None:
    """Find the object in the next frame.

    Args:
        track: What is known up to the last frame.
        templates: What is known of the object's looks by now; may be newer than those of the track.
        view: The next frame, of the size of the last one.
        box: The object's box.

    Returns:
        The track in the next frame; None where the object is not seen there.
    """
    now, before = track.pose.cam_from_world, track.before_cam_from_world
    expected = foretold(now, before) if before else now
    for guess in (_flowed(track, view, expected), expected):
        followed = guess and _settled(templates, view, guess, box)
        if followed:
            return replace(followed, before_cam_from_world=now)
    return None


def _flowed(track: Track, view: View, expected: pycolmap.Rigid3d) -> pycolmap.Rigid3d | None:
    """The pose that the flow of the points seen tells of, or None."""
    points3D = track.templates.points3D_in_world[track.seen.rows]
    now, then = (project(points3D, pose, view.camera) for pose in (expected, track.pose.cam_from_world))
    flow = follow_points(track.view.gray, view.gray, track.seen.points2D, track.seen.points2D + now - then)
    search = RansacOptions(max_error_px=_MAX_FLOW_ERROR_PX, min_inliers=_MIN_POINTS)
    estimate = estimate_pose(flow.points2D[flow.found], points3D[flow.found], view.camera, search)
    return estimate and estimate.cam_from_world


def _settled(
    templates: Templates, view: View, guess: pycolmap.Rigid3d, box: Box, rounds: int = _ROUNDS
) -> Track | None:
    """The track whose pose the templates found near a guess agree on; None where too few do."""
    seen = find(templates, view, guess)
    if len(seen.rows) < max(_MIN_POINTS, _MIN_SHARE * seen.num_expected):
        return None
    points3D = templates.points3D_in_world[seen.rows]
    pose = refine_pose(seen.points2D, points3D, guess, view.camera, max_error_px=_MAX_ERROR_PX)
    moved = project(points3D, pose.cam_from_world, view.camera) - project(points3D, guess, view.camera)
    if rounds > 1 and np.median(np.linalg.norm(moved, axis=1)) > _SETTLED_PX:
        return _settled(templates, view, pose.cam_from_world, box, rounds - 1)
    track = Track(templates=templates, view=view, pose=pose, before_cam_from_world=None, seen=seen)
    return _believed(track, box)


def _believed(track: Track, box: Box) -> Track | None:
    """The track without the points that its pose does not fit; None unless enough fit and fix the pose."""
    seen, fits = track.seen, track.pose.inliers
    enough = max(_MIN_POINTS, _MIN_SHARE * seen.num_expected, len(fits) / 2)
    if fits.sum() < enough or track.pose.predicted_corner_error(box) > MAX_CORNER_ERROR:
        return None
    fitting = Sighting(rows=seen.rows[fits], points2D=seen.points2D[fits], num_expected=seen.num_expected)
    return replace(track, seen=fitting, pose=replace(track.pose, inliers=fits[fits]))
