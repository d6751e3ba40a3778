"""Smooth maps from the pixels of an image to those of another version of it.

What undistorts, resizes or crops an image moves neighboring pixels alike, so that a polynomial describes it.
Two lists of pixels in different order, or of different images, have no such map. Therefore lists can be
compared without knowing the lens.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from slimsfm.arrays import Points2D

_DEGREES = (5, 3, 1)
_ROWS_PER_TERM = 3
_KEPT = 0.9  # share of rows that the second fit keeps: points at the rim may be extreme


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelMap:
    """A polynomial map of the plane."""

    degree: int
    """Degree of the polynomial."""

    center: Float64[np.ndarray, "2"]
    """Origin of its variables."""

    unit: float
    """Pixels per unit of its variables."""

    coefficients: Float64[np.ndarray, "terms 2"]
    """Row i belongs to term i; the first three are 1, x and y."""

    def __call__(self, pixels: Points2D) -> Points2D:
        """Map pixels."""
        return _terms((pixels - self.center) / self.unit, self.degree) @ self.coefficients

    @property
    def linear(self) -> Float64[np.ndarray, "2 2"]:
        """Derivative of the map at its center."""
        return self.coefficients[1:3].T / self.unit

    @property
    def scale(self) -> float:
        """Enlargement at the center of the map."""
        return float(np.sqrt(abs(np.linalg.det(self.linear))))

    @property
    def turn_deg(self) -> float:
        """Angle by which the map turns its center, from -180 to 180."""
        (a, b), (c, d) = self.linear
        return float(np.degrees(np.arctan2(c - b, a + d)))

    @property
    def is_upright(self) -> bool:
        """Whether the map neither turns, mirrors nor squeezes the image: undistortion and resizing do not."""
        strengths = np.linalg.svd(self.linear, compute_uv=False)
        squeezed = strengths[1] < 0.7 * strengths[0]
        return bool(np.linalg.det(self.linear) > 0 and not squeezed and abs(self.turn_deg) < 10)


def fit_pixel_map(source: Points2D, target: Points2D) -> PixelMap | None:
    """Fit the map from `source` to `target` by least squares, of a degree that the number of rows allows.

    Returns:
        The map; None if the rows are too few.
    """
    degree = next((d for d in _DEGREES if len(source) >= _ROWS_PER_TERM * (d + 1) * (d + 2) // 2), None)
    if degree is None:
        return None
    center = source.mean(axis=0)
    unit = max(float(np.abs(source - center).max()), 1e-9)
    terms = _terms((source - center) / unit, degree)
    coefficients = np.linalg.lstsq(terms, target, rcond=None)[0]
    errors = np.linalg.norm(terms @ coefficients - target, axis=1)
    rows = np.argsort(errors, kind="stable")[: int(np.ceil(_KEPT * len(source)))]
    coefficients = np.linalg.lstsq(terms[rows], target[rows], rcond=None)[0]
    return PixelMap(degree=degree, center=center, unit=unit, coefficients=coefficients)


def _terms(pixels: Points2D, degree: int) -> Float64[np.ndarray, "n terms"]:
    x, y = pixels.T
    powers = [(total - j, j) for total in range(degree + 1) for j in range(total + 1)]
    return np.stack([x**i * y**j for i, j in powers], axis=1)
