"""Whether positions contradict the images: they fit if they are stretched in some direction, or mirrored."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.stats import t as student

from slimsfm.arrays import Points3D
from slimsfm.errors import InputError
from slimsfm.upkeep.similarity import inliers_of, sampled, thickness

_LEAST_STRETCH = 1.15  # that the factor must exceed with confidence
_CONFIDENCE = 0.999
_FLAT = 0.03  # of the longest principal axis: no direction to measure a stretch in
_MIN_FREEDOM = 6
_ACCURACY = 1e-2  # of SfM, over the extent of the positions


@dataclass(frozen=True, kw_only=True, eq=False)
class Stretch:
    """How positions are stretched against those that images give."""

    factor: float
    """Length in one direction over length in another one, both over those that the images give."""

    direction: Float64[np.ndarray, "3"]
    """Unit vector of the longer one in the frame of the positions."""

    least_factor: float
    """What the factor exceeds with a probability of 99.9 %."""

    is_mirrored: bool
    """Whether the positions are a mirror image."""


def stretch_between(source: Points3D, target: Points3D, *, seed: int = 0) -> Stretch | None:
    """Measure how positions are stretched against their source; None if there are too few to tell.

    An affine map along the principal axes of the source in which it extends is fitted as `fit_similarity`
    fits a similarity. Its singular values are equal if that would have done.
    """
    sizes = thickness(source)
    axes = [k for k in (2, 3) if k <= len(sizes) and sizes[k - 1] > _FLAT * sizes[0]]
    found = [_stretch(source, target, k, seed) for k in axes]
    known = [one for one in found if one is not None]
    return max(known, key=lambda one: one.least_factor, default=None)


def check_not_stretched(source: Points3D, target: Points3D, what: str, axes: tuple[str, str, str]) -> None:
    """Check that positions do not contradict the images.

    Args:
        source: Positions that the images give.
        target: Positions to check.
        what: What they are, in the plural: "positions".
        axes: Names of the axes of the target.

    Raises:
        InputError: They are stretched or mirrored.
    """
    found = stretch_between(source, target)
    if found is None:
        return
    if found.is_mirrored:
        raise InputError(
            f"the {what} are a mirror image of what the images show: two coordinates are swapped, or one has "
            "the wrong sign"
        )
    if found.least_factor > _LEAST_STRETCH:
        raise InputError(
            f"the {what} contradict the images: {_named(found.direction, axes)}, they are stretched by a "
            f"factor of {found.factor:.2f}, which no choice of scale explains; correct them"
        )


def _named(direction: Float64[np.ndarray, "3"], axes: tuple[str, str, str]) -> str:
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 0.95:
        return f"along {axes[largest]}"
    parts = ", ".join(f"{value:.2f}" for value in direction * np.sign(direction[largest]))
    return f"along ({parts}) in {', '.join(axes)}"


def _stretch(source: Points3D, target: Points3D, k: int, seed: int) -> Stretch | None:
    center, _, vectors = _principal(source)
    along = (source - center) @ vectors[:k].T
    distances, rows = _least_median(along, target, sampled(len(source), k + 1, seed))
    floor = _ACCURACY * float(np.linalg.norm(target.std(axis=0)))
    design = np.column_stack([along, np.ones(len(along))])
    solution = np.linalg.lstsq(design[rows], target[rows])[0]

    def fit(kept: np.ndarray) -> Float64[np.ndarray, " n"]:
        nonlocal solution
        solution = np.linalg.lstsq(design[kept], target[kept])[0]
        return np.linalg.norm(design @ solution - target, axis=1)

    kept = inliers_of(fit, distances, floor)
    freedom = 3 * int(kept.sum()) - 3 * (k + 1)
    if freedom < _MIN_FREEDOM:
        return None
    sigma = max(float(np.sqrt(np.sum(fit(kept)[kept] ** 2) / freedom)), floor)
    centered = along[kept] - along[kept].mean(axis=0)
    if thickness(np.pad(centered, ((0, 0), (0, 3 - k))))[k - 1] <= 0:
        return None
    return _measured(solution[:k].T, np.linalg.inv(centered.T @ centered) * sigma**2, freedom, vectors)


def _principal(source: Points3D) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    center = source.mean(axis=0)
    _, values, vectors = np.linalg.svd(source - center, full_matrices=True)
    vectors[2] *= np.linalg.det(vectors)
    return center, values, vectors


def _least_median(
    along: Float64[np.ndarray, "n k"], target: Points3D, samples: Int64[np.ndarray, "m size"]
) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " size"]]:
    """The distances after the best fit to a sample, and the sample."""
    design = np.column_stack([along, np.ones(len(along))])
    best, found = np.inf, (np.full(len(along), np.inf), samples[0])
    for rows in samples:
        if np.linalg.matrix_rank(design[rows]) < design.shape[1]:
            continue
        distances = np.linalg.norm(design @ np.linalg.solve(design[rows], target[rows]) - target, axis=1)
        if np.median(distances) < best:
            best, found = np.median(distances), (distances, rows)
    return found


def _measured(
    linear: Float64[np.ndarray, "3 k"],
    covariance: Float64[np.ndarray, "k k"],
    freedom: int,
    vectors: np.ndarray,
) -> Stretch:
    """The stretch of a linear map from principal axes."""
    left, values, right = np.linalg.svd(linear, full_matrices=False)
    variances = np.einsum("ij,jk,ik->i", right, covariance, right) / values**2
    factor = values[0] / values[-1]
    spread = np.sqrt(variances[0] + variances[-1])
    quantile = student.ppf(_CONFIDENCE, freedom)
    weakest = 1 / np.sqrt(variances[-1])
    return Stretch(
        factor=float(factor),
        direction=left[:, 0],
        least_factor=float(factor * np.exp(-quantile * spread)),
        is_mirrored=len(values) == 3 and np.linalg.det(linear @ vectors) < 0 and weakest > quantile,
    )
