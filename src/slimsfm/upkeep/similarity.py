"""The similarity between two frames from positions that are known in both, some of them wrong.

Least median of squares [1] finds the positions that agree, least squares [2] the similarity of these. The
covariance says what they determine: all that is refused, is refused because of it.

[1] Rousseeuw, Least Median of Squares Regression, JASA 1984.
[2] Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point Patterns, PAMI 1991.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64
from scipy.stats import t as student

from slimsfm.arrays import Mask, Points3D
from slimsfm.errors import InputError

_SAMPLES = 1000
_MEDIAN = 1.538  # of the length of a normal vector in space, over the standard deviation of a coordinate
_INLIER = 3.37  # 99 % of such lengths, over the same
_ACCURACY = 1e-2  # of SfM, which drifts, over the extent of the positions
_ROUNDS = 20

MAX_TURN_DEG = 10.0
"""Largest 95 % bound of a rotation that counts as determined."""

MAX_SCALE_ERROR = 0.15
"""Largest 95 % bound of a scale that counts as determined."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Similarity:
    """A similarity, with the positions that it was computed from and what they determine."""

    target_from_source: pycolmap.Sim3d
    """The similarity."""

    is_inlier: Mask
    """Which positions agree with it."""

    residuals: Float64[np.ndarray, " n"]
    """Distance of every position to where the similarity puts it, in units of the target."""

    sigma: float
    """Standard deviation of a coordinate of the inliers, in units of the target."""

    turn_covariance: Float64[np.ndarray, "3 3"]
    """Covariance of the rotation, in radians about the axes of the target; infinite where it is open."""

    log_scale_sigma: float
    """Standard deviation of the logarithm of the scale; infinite if it is open."""

    quantile: float
    """Standard deviations within which 95 % lie, by Student's t."""

    @property
    def turn_bound_deg(self) -> float:
        """Bound of the error of the rotation about its least certain axis; 95 % are below."""
        worst = (
            np.linalg.eigvalsh(self.turn_covariance)[-1]
            if np.isfinite(self.turn_covariance).all()
            else np.inf
        )
        return float(np.degrees(self.quantile * np.sqrt(worst)))

    @property
    def heading_bound_deg(self) -> float:
        """Bound of the error of the rotation about the third axis of the target; 95 % are below."""
        return float(np.degrees(self.quantile * np.sqrt(self.turn_covariance[2, 2])))

    @property
    def scale_bound(self) -> float:
        """Bound of the relative error of the scale; 95 % are below."""
        return self.quantile * self.log_scale_sigma


def fit_similarity(source: Points3D, target: Points3D, *, seed: int = 0) -> Similarity:
    """Find the similarity that most positions agree with; fewer than half may be wrong.

    Args:
        source: Positions in one frame, exact in comparison.
        target: The same positions in the other frame, with errors of any size.
        seed: Seed of the samples.

    Raises:
        InputError: There are fewer than three positions, or they are all in one place.
    """
    if len(source) < 3:
        raise InputError(f"a similarity needs at least 3 positions, but {len(source)} can be used")
    if not np.ptp(source, axis=0).any() or not np.ptp(target, axis=0).any():
        raise InputError(f"the {len(source)} positions are all in one place, which determines nothing")
    samples = sampled(len(source), 3, seed)
    fits = [pycolmap.estimate_sim3d(source[rows], target[rows]) for rows in samples]
    found = least_median([fit for fit in fits if fit is not None], source, target)
    if found is None:
        raise InputError(f"the {len(source)} positions lie on a line or in one place; add some beside it")
    return refined(found, source, target)


def sampled(count: int, size: int, seed: int) -> Int64[np.ndarray, "k size"]:
    """All sets of so many rows, or a thousand random ones."""
    if comb(count, size) <= _SAMPLES:
        return np.array(list(combinations(range(count), size)), np.int64).reshape(-1, size)
    rng = np.random.default_rng(seed)
    return np.array([rng.choice(count, size, replace=False) for _ in range(_SAMPLES)], np.int64)


def least_median(fits: list[pycolmap.Sim3d], source: Points3D, target: Points3D) -> pycolmap.Sim3d | None:
    """The fit with the smallest median distance; the first of equal ones, None of none."""
    if not fits:
        return None
    medians = [np.median(np.linalg.norm(fit * source - target, axis=1)) for fit in fits]
    return fits[int(np.argmin(medians))]


def spread_of(distances: Float64[np.ndarray, " n"], unknowns: int) -> float:
    """Robust standard deviation of a coordinate, from distances after a fit of so many unknowns."""
    correction = 1 + 5 / max(3 * len(distances) - unknowns, 1)
    return float(np.median(distances)) / _MEDIAN * correction


def inliers_of(
    fit: Callable[[Mask], Float64[np.ndarray, " n"]], distances: Float64[np.ndarray, " n"], floor: float
) -> Mask:
    """Fit to the inliers until they no longer change; `fit` returns the distances of all."""
    kept = np.zeros(len(distances), bool)
    for _ in range(_ROUNDS):
        now = distances <= _INLIER * max(spread_of(distances, 7), floor)
        if np.array_equal(now, kept):
            break
        kept, distances = now, fit(now)
    return kept


def refined(start: pycolmap.Sim3d, source: Points3D, target: Points3D) -> Similarity:
    """Least squares over the positions that agree with a first similarity, with its uncertainty."""
    floor = _ACCURACY * _extent(start * source)
    found = start

    def fit(rows: Mask) -> Float64[np.ndarray, " n"]:
        nonlocal found
        found = pycolmap.estimate_sim3d(source[rows], target[rows]) or found
        return np.linalg.norm(found * source - target, axis=1)

    kept = inliers_of(fit, np.linalg.norm(start * source - target, axis=1), floor)
    residuals = fit(kept)
    freedom = max(3 * int(kept.sum()) - 7, 1)
    sigma = max(float(np.sqrt(np.sum(residuals[kept] ** 2) / freedom)), floor)
    offsets = found * source[kept]
    offsets = offsets - offsets.mean(axis=0)
    return Similarity(
        target_from_source=found,
        is_inlier=kept,
        residuals=residuals,
        sigma=sigma,
        turn_covariance=_inverse(turn_information(offsets, sigma)),
        log_scale_sigma=float(sigma / np.linalg.norm(offsets)),
        quantile=float(student.ppf(0.975, freedom)),
    )


def turn_information(offsets: Points3D, sigma: float) -> Float64[np.ndarray, "3 3"]:
    """What positions, as offsets from their mean, say about a rotation: inverse of its covariance."""
    return (np.sum(offsets**2) * np.eye(3) - offsets.T @ offsets) / sigma**2


def _inverse(information: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    values, axes = np.linalg.eigh(information)
    if values[0] <= 1e-12 * values[-1]:
        return np.full((3, 3), np.inf)
    return axes / values @ axes.T


def _extent(positions: Points3D) -> float:
    """Root mean square distance from the mean."""
    return float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))


def thickness(positions: Points3D) -> Float64[np.ndarray, "3"]:
    """Root mean square extents along the principal axes, largest first."""
    return np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False) / np.sqrt(len(positions))


def check_determined(found: Similarity, source: Points3D, what: str) -> None:
    """Check that the positions determine the similarity.

    Args:
        found: The similarity.
        source: All positions in the source.
        what: What they are, in the plural: "positions".

    Raises:
        InputError: They leave rotation or scale open, in view of their own errors.
    """
    kept = found.is_inlier
    scale = found.target_from_source.scale
    length, width, _ = np.pad(scale * thickness(source[kept]), (0, 3))[:3]
    number, size = int(kept.sum()), f"{np.sqrt(12) * length:.3g} m"
    if found.scale_bound > MAX_SCALE_ERROR:
        raise InputError(
            f"the {number} {what} that agree do not determine the scale: they extend over about {size} and "
            f"err by {found.sigma:.3g} m, so it may be {percent(found.scale_bound)} off; use {what} that are "
            "further apart, more, or more exact"
        )
    if found.turn_bound_deg > MAX_TURN_DEG:
        reason = f"they extend over {size} by {np.sqrt(12) * width:.3g} m and err by {found.sigma:.3g} m"
        if width < 0.05 * length:
            reason = f"they lie on a line ({reason})"
        raise InputError(
            f"the {number} {what} that agree do not determine how the map is turned: {reason}, so it may be "
            f"{_degrees(found.turn_bound_deg)} off; add some beside the line, or more, or more exact ones"
        )


def percent(share: float) -> str:
    """A relative error as text."""
    return f"{100 * share:.2g} %" if share < 1 else "any amount"


def _degrees(angle: float) -> str:
    return f"{angle:.2g}°" if angle < 90 else "any angle"
