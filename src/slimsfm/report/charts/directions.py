"""Directions on the viewing sphere, and how they are laid flat without changing areas."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points2D, Points3D
from slimsfm.evaluation.protocol import PosedQuery
from slimsfm.evaluation.results import Outcomes
from slimsfm.geometry import ADD_FRACTIONS, Box
from slimsfm.mapping.map import Map
from slimsfm.report.scene3d import view_frame

Verdict = Literal["right", "wrong", "not localized"]
"""What became of a query; right: off by less than a tenth of the diagonal."""

_WIDEST_DEG = 105.0  # about the middle of an azimuthal map; beyond it the whole sphere is shown
_STEEP_DEG = 30.0  # cameras whose middle is so near the zenith are seen from the zenith
_STEP_DEG = 15  # in which the rim of an azimuthal map is chosen
_ROUNDS = 30  # of Newton's method


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferencePlace:
    """A reference image on the viewing sphere."""

    cam_from_world: pycolmap.Rigid3d
    """Its pose."""

    kept: bool
    """Whether the reduced map has it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryPlace:
    """A query on the viewing sphere."""

    cam_from_world: pycolmap.Rigid3d
    """Its true pose."""

    before: Verdict
    """What became of it against the full map."""

    after: Verdict
    """What became of it against the reduced map."""


def reference_places(full: Map, reduced: Map) -> list[ReferencePlace]:
    """The reference images of a map, and which of them a reduced one keeps."""
    return [
        ReferencePlace(cam_from_world=image.cam_from_world(), kept=name in reduced.images)
        for name, image in full.images.items()
    ]


def query_places(queries: Sequence[PosedQuery], before: Outcomes, after: Outcomes) -> list[QueryPlace]:
    """Queries and what became of them against the full and the reduced map.

    Raises:
        ValueError: There are not as many outcomes as queries.
    """
    return [
        QueryPlace(cam_from_world=query.cam_from_world, before=one, after=other)
        for query, one, other in zip(queries, verdicts(before), verdicts(after), strict=True)
    ]


def verdicts(outcomes: Outcomes) -> list[Verdict]:
    """What became of each query."""
    poses = zip(outcomes.error, outcomes.cam_from_world, strict=True)
    return [
        "not localized" if pose is None else "right" if error < ADD_FRACTIONS[0] else "wrong"
        for error, pose in poses
    ]


def directions(
    cams_from_world: Sequence[pycolmap.Rigid3d], box: Box, frame_of: Sequence[pycolmap.Rigid3d]
) -> Points3D:
    """Unit vectors from the middle of a box to cameras, in the frame that `view_frame` finds for others."""
    centers = np.array([pose.inverse().translation for pose in cams_from_world], np.float64).reshape(-1, 3)
    towards = view_frame(list(frame_of), box).apply(centers)
    return towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)


def angles_deg(directions: Points3D) -> Float64[np.ndarray, "n 2"]:
    """Azimuth in (-180, 180], from x towards y, and elevation in [-90, 90]."""
    x, y, z = directions.T
    return np.degrees(np.stack([np.arctan2(y, x), np.arcsin(np.clip(z, -1, 1))], axis=1))


def from_angles(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> Points3D:
    """Unit vectors of azimuths and elevations, the inverse of `angles_deg`."""
    azimuth, elevation = np.broadcast_arrays(np.radians(azimuth_deg), np.radians(elevation_deg))
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Projection:
    """An equal-area map of the sphere, or of the part of it around a middle."""

    middle: Float64[np.ndarray, "3"] | None
    """Where Lambert's azimuthal map touches the sphere; None for Mollweide's map of all of it."""

    reach_deg: float
    """How far from the middle the map goes."""

    @property
    def is_from_above(self) -> bool:
        """Whether its middle is the zenith."""
        return self.middle is not None and bool(self.middle[2] == 1)

    @property
    def radius(self) -> float:
        """Of the rim of Lambert's map; of the sphere it is 1."""
        return 2 * np.sin(np.radians(self.reach_deg) / 2)

    def apply(self, directions: Points3D) -> Points2D:
        """Where unit vectors lie on the map.

        Seen from outside the sphere, so that azimuth grows to the right; from above the front, azimuth 0, is
        at the bottom.
        """
        return mollweide(directions) if self.middle is None else lambert(directions, self.middle)

    def shows(self, directions: Points3D) -> np.ndarray:
        """Which unit vectors are within reach."""
        if self.middle is None:
            return np.ones(len(directions), bool)
        return directions @ self.middle >= np.cos(np.radians(self.reach_deg)) - 1e-9


def fitting_projection(directions: Points3D) -> Projection:
    """The map that shows what is there best: around the middle of the directions or the zenith, or of all."""
    middle = directions.mean(axis=0)
    length = float(np.linalg.norm(middle))
    zenith = np.array([0.0, 0.0, 1.0])
    steep = length < 1e-6 or middle[2] / length >= np.cos(np.radians(_STEEP_DEG))
    center = zenith if steep else middle / length
    farthest = float(np.degrees(np.arccos(np.clip(directions @ center, -1, 1)).max()))
    if farthest > _WIDEST_DEG:
        return Projection(middle=None, reach_deg=180.0)
    reach = _STEP_DEG * max(2, int(np.ceil((farthest + 2) / _STEP_DEG)))
    return Projection(middle=center, reach_deg=float(reach))


def lambert(directions: Points3D, middle: Float64[np.ndarray, "3"]) -> Points2D:
    """Lambert's azimuthal equal-area map of unit vectors around a middle; its opposite is all of the rim."""
    right = np.array([-middle[1], middle[0], 0.0])
    length = np.linalg.norm(right)
    right = right / length if length > 1e-9 else np.array([0.0, 1.0, 0.0])
    up = np.cross(middle, right)
    scale = np.sqrt(2 / np.maximum(1 + directions @ middle, 1e-12))
    return np.stack([scale * (directions @ right), scale * (directions @ up)], axis=1)


def mollweide(directions: Points3D) -> Points2D:
    """Mollweide's equal-area map of unit vectors: an ellipse of twice the width, azimuth 0 in its middle."""
    azimuth, elevation = np.radians(angles_deg(directions)).T
    angle = elevation.copy()
    for _ in range(_ROUNDS):
        slope = np.maximum(2 + 2 * np.cos(2 * angle), 1e-9)
        angle -= (2 * angle + np.sin(2 * angle) - np.pi * np.sin(elevation)) / slope
        angle = np.clip(angle, -np.pi / 2, np.pi / 2)
    return np.stack([2 * np.sqrt(2) / np.pi * azimuth * np.cos(angle), np.sqrt(2) * np.sin(angle)], axis=1)
