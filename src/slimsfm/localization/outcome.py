"""Outcome of localizing one query."""

from dataclasses import dataclass

import numpy as np
import pycolmap

from slimsfm.arrays import Points2D, Points3D
from slimsfm.localization.cameras import CameraSource
from slimsfm.photos import Orientation
from slimsfm.pose import PoseEstimate


@dataclass(frozen=True, kw_only=True)
class Seconds:
    """Wall time of each stage."""

    extract: float
    """Extracting the features of the query."""

    match: float
    """Matching the query with the map."""

    pose: float
    """Estimating and verifying poses."""

    @property
    def total(self) -> float:
        """Sum of all stages."""
        return self.extract + self.match + self.pose


@dataclass(frozen=True, kw_only=True, eq=False)
class Localization:
    """Outcome of one query."""

    pose: PoseEstimate | None
    """Pose of the camera; None if the query could not be localized."""

    reason: str | None = None
    """Why there is no pose; None if there is one."""

    is_skipped: bool = False
    """Whether the query was not searched, because it cannot be read or its intrinsics are not known."""

    camera: pycolmap.Camera
    """The intrinsics, with those that were estimated; an empty camera, of no model, if it was skipped."""

    camera_source: CameraSource = "given"
    """Where the intrinsics come from, apart from those that were estimated."""

    camera_notes: tuple[str, ...] = ()
    """Sentences that name the image, on what was ignored when its camera was chosen."""

    points2D: Points2D
    """Pixels of the 2D-3D matches that the pose was estimated from."""

    points3D_in_world: Points3D
    """Point of the map for each of these pixels."""

    references: int
    """Number of reference images that the query was matched with."""

    predicted_corner_error: float | None = None
    """Expected relative corner error of the pose, if its inliers are right; None if there is no pose."""

    seconds: Seconds
    """Wall time per stage."""

    orientation: Orientation = "upright"
    """Which pixels of the image the pose is of: as in the map."""

    @classmethod
    def skipped(cls, reason: str, orientation: Orientation = "upright") -> "Localization":
        """The outcome of a query that was not searched."""
        return cls(
            pose=None,
            reason=reason,
            is_skipped=True,
            camera=pycolmap.Camera(),
            camera_source="unknown",
            points2D=np.zeros((0, 2)),
            points3D_in_world=np.zeros((0, 3)),
            references=0,
            seconds=Seconds(extract=0.0, match=0.0, pose=0.0),
            orientation=orientation,
        )

    @property
    def camera_estimated(self) -> tuple[str, ...]:
        """Which intrinsics were estimated: "focal length", "principal point", "pixel aspect ratio"."""
        return self.pose.estimated if self.pose else ()

    @property
    def num_matches(self) -> int:
        """Number of 2D-3D matches."""
        return len(self.points2D)
