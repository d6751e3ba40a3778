"""Curves of a frontier: what is lost and how long a query takes, over the size of the map."""

from collections.abc import Callable, Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from slimsfm.evaluation.table import format_bytes
from slimsfm.reduction import Candidate, Frontier
from slimsfm.report.figures import COLORS, INK, mark_logarithmic, new_figure, styled

_LEAST_MS = 1e-3  # on the axis of times
_RING: dict[str, Any] = {"marker": "o", "ms": 12, "mfc": "none", "mec": INK, "mew": 1.2, "ls": "none"}


def curves_figure(frontier: Frontier, recommended: Mapping[str, Candidate], full_bytes: int) -> Figure:
    """Draw two charts side by side: loss over bytes and time over bytes, a curve a use and method.

    Args:
        frontier: What was tried.
        recommended: By use; drawn with a ring.
        full_bytes: Size of the full map; drawn as a line.
    """
    chosen = list(recommended.values())
    with styled():
        figure = new_figure(9.0, 4.2, "Loss and time over the size of the map")
        losses, times = figure.subplots(1, 2)
        _draw(losses, frontier, chosen, lambda one: one.loss)
        _draw(times, frontier, chosen, lambda one: max(1e3 * one.seconds, _LEAST_MS))
        losses.set_title("points lost against the full map (%)")
        times.set_title("matching + pose a query (ms)")
        times.set_yscale("log")
        times.margins(y=0.1)
        mark_logarithmic(times.yaxis, lambda value: f"{value:g}")
        low, high = losses.dataLim.intervaly
        losses.set_ylim(min(low, 0) - 1, max(high, 0) + 1)
        for axes in (losses, times):
            axes.axvline(full_bytes, color=INK, alpha=0.4, lw=1, ls=(0, (5, 4)), label="full map")
            axes.margins(x=0.08)
            mark_logarithmic(axes.xaxis, format_bytes)
            axes.grid(visible=True)
        handles = losses.get_legend_handles_labels()[0]
        handles.append(Line2D([], [], label="recommended", **_RING))
        figure.legend(handles=handles, loc="outside lower center", ncols=6, handlelength=1.5)
    return figure


def _draw(
    axes: Axes, frontier: Frontier, chosen: list[Candidate], value: Callable[[Candidate], float]
) -> None:
    for number, (name, series) in enumerate(_series(frontier).items()):
        color = COLORS[number % len(COLORS)]
        sizes, values = [one.bytes for one in series], [value(one) for one in series]
        axes.plot(sizes, values, "o-", ms=3.5, lw=1.5, color=color, label=name)
        ringed = [k for k, one in enumerate(series) if any(one is best for best in chosen)]
        axes.plot([sizes[k] for k in ringed], [values[k] for k in ringed], **_RING)
    axes.set_xscale("log")
    axes.set_xlabel("size of the map (logarithmic)")


def _series(frontier: Frontier) -> dict[str, list[Candidate]]:
    """The candidates of each use and method, by size."""
    names = sorted({_name(one) for one in frontier.candidates})
    return {
        name: sorted((one for one in frontier.candidates if _name(one) == name), key=lambda one: one.bytes)
        for name in names
    }


def _name(one: Candidate) -> str:
    return f"{one.choice.use}: {one.choice.method}"
