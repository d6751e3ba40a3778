"""Confidence against how often poses are right."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from slimsfm.evaluation.results import Outcomes
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.report.charts.calibration import BINS, Calibration, calibration
from slimsfm.report.figures import COLORS, INK, new_figure, styled
from slimsfm.report.formatting import plural


def reliability_chart(outcomes: Outcomes) -> Figure:
    """How often poses of each confidence are right, with 95 % intervals, above how many there are.

    On the diagonal confidence is what it says: the probability that a pose is right.

    Args:
        outcomes: Of queries; those without a pose are counted in the heading alone.
    """
    found = calibration(outcomes)
    with styled():
        figure = new_figure(4.8, 5.8, "How often poses of each confidence are right")
        shares, counts = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1))
        _draw_shares(shares, found)
        _draw_counts(counts, found)
        _write_sums(shares, found)
    return figure


def _draw_shares(axes: Axes, found: Calibration) -> None:
    axes.plot([0, 1], [0, 1], color=INK, alpha=0.5, lw=1, ls=(0, (5, 4)), label="as it says")
    there = found.counts > 0
    x, y = found.confidence[there], found.right[there]
    ends = np.maximum([y - found.low[there], found.high[there] - y], 0)
    axes.errorbar(x, y, ends, fmt="o", ms=6, color=COLORS[0], elinewidth=1.4, capsize=3, label="poses")
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    axes.set_ylabel(f"share that is right (off by < {ADD_FRACTIONS[0]} d)")
    axes.grid(visible=True)


def _draw_counts(axes: Axes, found: Calibration) -> None:
    middles = (np.arange(BINS) + 0.5) / BINS
    bars = axes.bar(middles, found.counts, width=0.94 / BINS, color=COLORS[0], alpha=0.75, label="counts")
    axes.bar_label(bars, [f"{count:,}" if count else "" for count in found.counts], fontsize=7, padding=1)
    axes.set_ylim(0, 1.25 * max(found.counts.max(), 1))
    axes.yaxis.set_major_locator(MaxNLocator(3, integer=True))
    axes.set_ylabel("poses")
    axes.set_xlabel("confidence")


def _write_sums(axes: Axes, found: Calibration) -> None:
    without = f", {plural(found.without, 'query')} without" if found.without else ""
    lines = [plural(found.poses, "pose") + without]
    if found.poses:
        lines += [
            f"expected calibration error {found.expected_error:.3f}",
            f"Brier score {found.brier:.3f}",
        ]
    axes.set_title("\n".join(lines), fontweight="normal", fontsize=9, linespacing=1.4)
