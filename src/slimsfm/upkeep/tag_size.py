"""How large a square tag is in map units: a flat square that projects where photos show its corners."""

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64
from scipy.optimize import least_squares

from slimsfm.arrays import Points3D, evenly_spaced
from slimsfm.errors import InputError
from slimsfm.geometry import project
from slimsfm.mapping.map import Map
from slimsfm.upkeep.similarity import percent
from slimsfm.upkeep.tags import TagView

_PAIRS = 150  # of photos that the corners are triangulated from
_SMALLEST_INLIER_PX, _INLIER = 2.0, 3.0  # least threshold, and medians
_LARGEST_PX = 0.01  # of the longer side: errors beyond are no inaccuracy
_LEAST_SIGMA_PX = 0.3
_MAX_ERROR = 0.05  # largest 95 % bound of a size
_SQUARE = np.array(
    [[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]]
)  # clockwise from top left


@dataclass(frozen=True, kw_only=True, eq=False)
class TagSize:
    """A tag in the map."""

    number: int
    """Number of the tag."""

    side: float
    """Length of its side, in map units."""

    relative_sigma: float
    """Standard deviation of the side over the side."""

    views: int
    """Number of photos that show it."""

    outliers: tuple[str, ...]
    """Names of those photos that show it elsewhere than the others do."""

    errors_px: Float64[np.ndarray, " k"]
    """Largest reprojection error of a corner, per photo that agrees."""

    corners3D_in_world: Float64[np.ndarray, "4 3"]
    """Its corners, clockwise from the top left."""


def measure_tag(map: Map, number: int, views: list[TagView]) -> TagSize:
    """Measure a tag by the poses of the photos that show it.

    The corners are triangulated from pairs of photos; most photos must agree with the best pair. Then a flat
    square is fitted to their corners, in pixels of the distorted lens.

    Raises:
        InputError: A single photo shows the tag, the photos contradict each other, or do not determine the
            size: their baseline is too short for the distance, or they see it at grazing angles.
    """
    if len(views) < 2:
        tilt = _tilt_deg(map, views[0])
        raise InputError(
            f"tag {number} is seen in one photo only ({views[0].image}, {tilt:.0f}° from its face), which "
            "does not determine its size in the map; add photos of it from other places"
        )
    corners, errors = _triangulated(map, views)
    limit = max(_SMALLEST_INLIER_PX, _INLIER * float(np.median(errors)))
    camera = map.camera(views[0].image)
    kept = errors <= min(limit, _LARGEST_PX * max(camera.width, camera.height))
    if 2 * kept.sum() <= len(views) or kept.sum() < 2:
        raise InputError(
            f"tag {number}: the {len(views)} photos that show it contradict each other; it was moved, or is "
            "there twice, or the map is wrong there; use another tag"
        )
    good = [view for view, is_good in zip(views, kept, strict=True) if is_good]
    fit = _fit_square(map, good, corners)
    if not 2 * fit.relative_sigma < _MAX_ERROR:
        raise InputError(
            f"tag {number}: the {len(good)} photos that show it do not determine its size, which may be "
            f"{percent(2 * fit.relative_sigma)} off; add photos from places further apart that see its face"
        )
    return TagSize(
        number=number,
        side=fit.side,
        relative_sigma=fit.relative_sigma,
        views=len(views),
        outliers=tuple(view.image for view, is_good in zip(views, kept, strict=True) if not is_good),
        errors_px=_errors(map, good, fit.corners),
        corners3D_in_world=fit.corners,
    )


def _errors(map: Map, views: list[TagView], corners3D_in_world: Points3D) -> Float64[np.ndarray, " k"]:
    """Largest error of a corner in each photo, in pixels; infinite behind the camera."""
    found = [
        np.linalg.norm(_projected(map, view, corners3D_in_world) - view.corners, axis=1).max()
        for view in views
    ]
    return np.nan_to_num(np.array(found), nan=np.inf)


def _projected(map: Map, view: TagView, corners3D_in_world: Points3D) -> Float64[np.ndarray, "4 2"]:
    pose = map.images[view.image].cam_from_world()
    return project(corners3D_in_world, pose, map.camera(view.image))


def _triangulated(map: Map, views: list[TagView]) -> tuple[Points3D, Float64[np.ndarray, " k"]]:
    """The corners from the pair of photos that most photos agree with, and their errors in all."""
    rays = [np.asarray(map.camera(view.image).cam_from_img(view.corners)) for view in views]
    poses = [map.images[view.image].cam_from_world().matrix() for view in views]
    pairs = list(combinations(range(len(views)), 2))
    best, found = np.inf, None
    for i, j in (pairs[row] for row in evenly_spaced(len(pairs), _PAIRS)):
        corners = [
            pycolmap.triangulate_point(poses[i], poses[j], a, b)
            for a, b in zip(rays[i], rays[j], strict=True)
        ]
        if any(corner is None for corner in corners):
            continue
        errors = _errors(map, views, np.array(corners, np.float64).reshape(4, 3))
        if np.median(errors) < best:
            best, found = float(np.median(errors)), (np.array(corners, np.float64).reshape(4, 3), errors)
    return found or (np.zeros((4, 3)), np.full(len(views), np.inf))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    side: float
    relative_sigma: float
    corners: Points3D


def _fit_square(map: Map, views: list[TagView], corners: Points3D) -> _Fit:
    """A flat square whose corners project with the least errors; large ones count little."""
    center, axes, side = _square_near(corners)

    def moved(values: Float64[np.ndarray, "7"]) -> Points3D:
        turn = cv2.Rodrigues(values[:3])[0]
        return center + side * (values[3:6] + np.exp(values[6]) * _SQUARE @ (axes @ turn).T)

    def errors(values: Float64[np.ndarray, "7"]) -> Float64[np.ndarray, " m"]:
        found = [_projected(map, view, moved(values)) - view.corners for view in views]
        return np.nan_to_num(np.concatenate(found).ravel(), nan=1e3)

    fit = least_squares(errors, np.zeros(7), loss="soft_l1", f_scale=1.0)
    freedom = max(len(fit.fun) - 7, 1)
    sigma = max(float(np.sqrt(2 * fit.cost / freedom)), _LEAST_SIGMA_PX)
    information = fit.jac.T @ fit.jac
    values = np.linalg.eigvalsh(information)
    is_open = values[0] <= 1e-12 * values[-1]
    spread = np.inf if is_open else sigma * float(np.sqrt(np.linalg.inv(information)[6, 6]))
    return _Fit(side=float(side * np.exp(fit.x[6])), relative_sigma=spread, corners=moved(fit.x))


def _square_near(corners: Points3D) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3 3"], float]:
    """Center, axes and side of the square nearest to four corners."""
    across = (corners[1] - corners[0] + corners[2] - corners[3]) / 2
    upward = (corners[0] - corners[3] + corners[1] - corners[2]) / 2
    side = (np.linalg.norm(across) + np.linalg.norm(upward)) / 2
    left, _, right = np.linalg.svd(np.stack([across, upward, np.cross(across, upward) / side], axis=1))
    return corners.mean(axis=0), left @ right, float(side)


def _tilt_deg(map: Map, view: TagView) -> float:
    """Angle between the ray to a tag and the direction that its face looks in, by a single photo."""
    rays = np.asarray(map.camera(view.image).cam_from_img(view.corners), np.float64)
    found, turn, shift = cv2.solvePnP(_SQUARE, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    if not found:
        return 90.0
    face, ray = cv2.Rodrigues(turn)[0][:, 2], shift.ravel()
    cosine = abs(face @ ray) / np.linalg.norm(ray)
    return float(np.degrees(np.arccos(np.clip(cosine, 0, 1))))
