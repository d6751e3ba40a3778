"""Whether a confidence means what it says: how often poses of each confidence are right."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from slimsfm.evaluation.results import Outcomes
from slimsfm.geometry import ADD_FRACTIONS

BINS = 10
"""Of equal width, from 0 to 1; the last one holds 1."""

_Z = 1.959963984540054  # of 95 %


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Confidence against truth, bin by bin. Values of a bin that holds no pose are NaN."""

    counts: Int64[np.ndarray, " bins"]
    """Poses of each bin."""

    confidence: Float64[np.ndarray, " bins"]
    """Their mean confidence."""

    right: Float64[np.ndarray, " bins"]
    """Share of them that is right: off by less than a tenth of the diagonal."""

    low: Float64[np.ndarray, " bins"]
    """Lower end of the 95 % interval of that share."""

    high: Float64[np.ndarray, " bins"]
    """Upper end of it."""

    expected_error: float
    """Expected calibration error: between confidence and share, averaged over the poses; NaN without any."""

    brier: float
    """Mean square of what the confidence differs from 1 for a right pose, from 0 for a wrong one; NaN without
    any."""

    without: int
    """Queries that have no pose, or none with a confidence; they count nowhere else."""

    @property
    def poses(self) -> int:
        """How many there are."""
        return int(self.counts.sum())


def calibration(outcomes: Outcomes) -> Calibration:
    """Compare the confidence of poses with whether they are right."""
    known = np.isfinite(outcomes.confidence)
    confidence, right = outcomes.confidence[known], outcomes.error[known] < ADD_FRACTIONS[0]
    bins = np.clip((BINS * confidence).astype(np.int64), 0, BINS - 1)
    counts = np.bincount(bins, minlength=BINS).astype(np.int64)
    means, shares = (_means(bins, counts, values) for values in (confidence, right.astype(np.float64)))
    low, high = wilson(shares, counts)
    gaps = np.nan_to_num(np.abs(means - shares))
    total = len(confidence)
    return Calibration(
        counts=counts,
        confidence=means,
        right=shares,
        low=low,
        high=high,
        expected_error=float(counts @ gaps / total) if total else np.nan,
        brier=_brier(confidence, right) if total else np.nan,
        without=int((~known).sum()),
    )


def _means(bins: np.ndarray, counts: np.ndarray, values: np.ndarray) -> Float64[np.ndarray, " bins"]:
    sums = np.bincount(bins, weights=values, minlength=BINS)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _brier(confidence: Float64[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> float:
    return float(np.mean((confidence - right) ** 2))


def wilson(
    shares: Float64[np.ndarray, " n"], counts: Int64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Ends of 95 % intervals of shares among so many, which hold where shares are 0 or 1, too [1].

    References:
        [1] Wilson, Probable Inference, the Law of Succession, and Statistical Inference, JASA 22, 1927.
    """
    counts = np.maximum(counts, 1)
    middle = (shares + _Z**2 / (2 * counts)) / (1 + _Z**2 / counts)
    reach = _Z * np.sqrt(shares * (1 - shares) / counts + _Z**2 / (4 * counts**2)) / (1 + _Z**2 / counts)
    return middle - reach, middle + reach
