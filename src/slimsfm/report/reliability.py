"""Whether confidence is calibrated: how often poses of each confidence are right."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from slimsfm.evaluation.results import Outcomes
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.report.figures import COLORS, INK, new_figure, styled
from slimsfm.report.formatting import format_count

_BINS = 10  # of equal width from 0 to 1; the last one includes 1
_Z = 1.959963984540054  # of 95 %


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Confidence against correctness, by bins of confidence. Values of empty bins are NaN."""

    counts: Int64[np.ndarray, " bins"]
    """Poses per bin."""

    confidence: Float64[np.ndarray, " bins"]
    """Mean confidence."""

    right: Float64[np.ndarray, " bins"]
    """Share of poses with an error below a tenth of the diagonal."""

    low: Float64[np.ndarray, " bins"]
    """Lower end of the 95 % interval of that share."""

    high: Float64[np.ndarray, " bins"]
    """Upper end of the 95 % interval of that share."""

    expected_error: float
    """Expected calibration error: mean gap between confidence and share over all poses; NaN without poses."""

    brier: float
    """Brier score: mean squared difference between confidence and correctness; NaN without poses."""

    without: int
    """Queries without a pose or without a confidence; counted nowhere else."""

    @property
    def poses(self) -> int:
        """Number of poses."""
        return int(self.counts.sum())


def calibration(outcomes: Outcomes) -> Calibration:
    """Compare the confidence of poses with their correctness."""
    known = np.isfinite(outcomes.confidence)
    confidence, right = outcomes.confidence[known], outcomes.error[known] < ADD_FRACTIONS[0]
    bins = np.clip((_BINS * confidence).astype(np.int64), 0, _BINS - 1)
    counts = np.bincount(bins, minlength=_BINS).astype(np.int64)
    means, shares = (
        np.where(counts > 0, np.bincount(bins, weights=one, minlength=_BINS) / np.maximum(counts, 1), np.nan)
        for one in (confidence, right.astype(np.float64))
    )
    low, high = wilson_interval(shares, counts)
    gaps = np.nan_to_num(np.abs(means - shares))
    total = len(confidence)
    return Calibration(
        counts=counts,
        confidence=means,
        right=shares,
        low=low,
        high=high,
        expected_error=float(counts @ gaps / total) if total else np.nan,
        brier=float(np.mean((confidence - right) ** 2)) if total else np.nan,
        without=int((~known).sum()),
    )


def wilson_interval(
    shares: Float64[np.ndarray, " n"], counts: Int64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Ends of 95 % intervals of shares of `counts` trials, valid for shares of 0 and 1 too [1].

    References:
        [1] Wilson, Probable Inference, the Law of Succession, and Statistical Inference, JASA 22, 1927.
    """
    counts = np.maximum(counts, 1)
    middle = (shares + _Z**2 / (2 * counts)) / (1 + _Z**2 / counts)
    reach = _Z * np.sqrt(shares * (1 - shares) / counts + _Z**2 / (4 * counts**2)) / (1 + _Z**2 / counts)
    return middle - reach, middle + reach


def reliability_chart(outcomes: Outcomes) -> Figure:
    """Draw how often poses of each confidence are right, with 95 % intervals, and the number of poses.

    On the diagonal, confidence is the probability that a pose is right.

    Args:
        outcomes: Outcomes of queries; those without a pose are only counted in the heading.
    """
    found = calibration(outcomes)
    with styled():
        figure = new_figure(4.8, 5.8, "How often poses of each confidence are right")
        shares, counts = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1))
        _draw_shares(shares, found)
        _draw_counts(counts, found)
        without = f", {format_count(found.without, 'query')} without" if found.without else ""
        lines = [format_count(found.poses, "pose") + without]
        if found.poses:
            lines += [f"expected calibration error {found.expected_error:.3f}"]
            lines += [f"Brier score {found.brier:.3f}"]
        shares.set_title("\n".join(lines), fontweight="normal", fontsize=9, linespacing=1.4)
    return figure


def _draw_shares(axes: Axes, found: Calibration) -> None:
    axes.plot([0, 1], [0, 1], color=INK, alpha=0.5, lw=1, ls=(0, (5, 4)), label="calibrated")
    there = found.counts > 0
    x, y = found.confidence[there], found.right[there]
    ends = np.maximum([y - found.low[there], found.high[there] - y], 0)
    axes.errorbar(x, y, ends, fmt="o", ms=6, color=COLORS[0], elinewidth=1.4, capsize=3, label="poses")
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    axes.set_ylabel(f"share of right poses (error < {ADD_FRACTIONS[0]} d)")
    axes.grid(visible=True)


def _draw_counts(axes: Axes, found: Calibration) -> None:
    middles = (np.arange(_BINS) + 0.5) / _BINS
    bars = axes.bar(middles, found.counts, width=0.94 / _BINS, color=COLORS[0], alpha=0.75, label="counts")
    axes.bar_label(bars, [f"{count:,}" if count else "" for count in found.counts], fontsize=7, padding=1)
    axes.set_ylim(0, 1.25 * max(found.counts.max(), 1))
    axes.yaxis.set_major_locator(MaxNLocator(3, integer=True))
    axes.set_ylabel("poses")
    axes.set_xlabel("confidence")
