"""Charts of accuracy over map size and query time, of benchmark results and of a frontier's predictions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import Bbox

from slimsfm.evaluation.scores import Interval
from slimsfm.evaluation.table import Row, format_bytes
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.reduction import Candidate, Frontier
from slimsfm.report.figures import COLORS, INK, PAPER, mark_logarithmic, new_figure, styled

_MARKERS = ("s", "o", "D", "^", "v", "P", "X", "p", "h", "<", ">")
_VARIANTS = ("full", "dominating", "default", "random")  # get the first markers
_FILLS = ("full", "none", "left", "top", "right", "bottom")
_WHOLE_QUERY = "whole query, from pixels to pose"
_MIN_MS = 1e-3  # on the axis of times
_ADD = f"add_{ADD_FRACTIONS[0]}d"
_RING: dict[str, Any] = {"marker": "o", "ms": 13, "mfc": "none", "mec": INK, "mew": 1.2, "ls": "none"}

_NEAR_PT, _FAR_PT = 7.0, 20.0  # between a mark and its label
_WAYS = tuple((x, y) for x, y in product((1, -1, 0), repeat=2) if (x, y) != (0, 0))
_OFFSETS = tuple((x * reach, y * reach) for reach in (_NEAR_PT, _FAR_PT) for x, y in _WAYS)
_MARK_PT = 4.0  # half the side of a mark
_LABEL_PT = 7.5  # font size


@dataclass(frozen=True, kw_only=True)
class TradeoffMark:
    """A map and the way it is matched, as a mark in the chart."""

    kinds: tuple[str, str, str]
    """What color, marker and fill of the mark stand for; empty if nothing."""

    bytes: float
    """Size of the map."""

    milliseconds: float
    """Time of a query."""

    accuracy: float
    """In percent, or percentage points; higher is better."""

    interval: Interval | None = None
    """95 % interval of the accuracy."""

    is_recommended: bool = False
    """Draw a ring around the mark."""

    @property
    def name(self) -> str:
        """Label of the mark."""
        return ", ".join(kind for kind in (self.kinds[2], self.kinds[0], self.kinds[1]) if kind)


def frontier_chart(rows: Sequence[Row]) -> Figure:
    """Draw ADD-0.1d over map size and over query time; the Pareto front is joined.

    Args:
        rows: Rows of one object, or of one average over objects.

    Raises:
        ValueError: `rows` is empty.
    """
    if not rows:
        raise ValueError("rows must hold at least one row")
    several = len({row.method for row in rows}) > 1
    marks = [
        TradeoffMark(
            kinds=(row.strategy, row.variant, row.method if several else ""),
            bytes=float(row.map_bytes),
            milliseconds=1e3 * row.scores.seconds.total,
            accuracy=row.scores.add[ADD_FRACTIONS[0]],
            interval=row.intervals.get(_ADD),
        )
        for row in rows
    ]
    label = f"ADD-{ADD_FRACTIONS[0]}d: queries localized (%)"
    return _chart(marks, label, ("strategy", "map", "method"), highest=100.0)


def curves_figure(frontier: Frontier, recommended: Mapping[str, Candidate], full_bytes: int) -> Figure:
    """Draw the predicted change in accuracy over map size and over query time; the Pareto front is joined.

    Args:
        frontier: The candidates.
        recommended: Recommended candidates by use, which get a ring.
        full_bytes: Size of the full map, drawn as a line.
    """
    seconds = [one.prediction.seconds for one in frontier.candidates]
    known = all(np.isfinite(one.total) for one in seconds)
    marks = [
        TradeoffMark(
            kinds=(one.choice.method, one.choice.use, ""),
            bytes=float(one.bytes),
            milliseconds=1e3 * (stages.total if known else stages.match + stages.pose),
            accuracy=-one.loss,
            is_recommended=any(one is best for best in recommended.values()),
        )
        for one, stages in zip(frontier.candidates, seconds, strict=True)
    ]
    label = "predicted change against the full map (points)"
    time = _WHOLE_QUERY if known else "matching and pose"
    return _chart(marks, label, ("method", "use", ""), highest=np.inf, full_bytes=full_bytes, time=time)


def pareto_front(costs: Sequence[float], gains: Sequence[float]) -> list[int]:
    """Indices of the entries that no other one beats, by increasing cost; the first of equal entries."""
    front: list[int] = []
    for i in sorted(range(len(costs)), key=lambda i: (costs[i], -gains[i], i)):
        if not front or gains[i] > gains[front[-1]]:
            front.append(i)
    return front


def _bytes(mark: TradeoffMark) -> float:
    return mark.bytes


def _milliseconds(mark: TradeoffMark) -> float:
    return max(mark.milliseconds, _MIN_MS)


def _chart(
    marks: Sequence[TradeoffMark],
    label: str,
    headings: tuple[str, str, str],
    *,
    highest: float,
    full_bytes: int | None = None,
    time: str = _WHOLE_QUERY,
) -> Figure:
    with styled():
        figure = new_figure(9.6, 4.2, "Accuracy over map size and over query time")
        by_size, by_time = figure.subplots(1, 2, sharey=True)
        looks = _Looks(marks)
        for axes, cost in ((by_size, _bytes), (by_time, _milliseconds)):
            _draw_marks(axes, marks, cost, looks)
        if full_bytes is not None:
            by_size.axvline(full_bytes, color=INK, alpha=0.4, lw=1, ls=(0, (5, 4)), label="full map")
        by_size.set_xlabel("size of the map (logarithmic)")
        by_time.set_xlabel(f"{time}, ms (logarithmic)")
        by_size.set_ylabel(label)
        by_size.set_yticks([tick for tick in by_size.get_yticks() if tick <= highest])
        by_size.set_ylim(*_limits(marks))
        mark_logarithmic(by_size.xaxis, format_bytes)
        mark_logarithmic(by_time.xaxis, lambda value: f"{value:g}")
        _draw_legend(figure, looks, headings, by_size)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # labels are placed in this layout
        for axes, cost in ((by_size, _bytes), (by_time, _milliseconds)):
            _label_front(axes, marks, cost)
    return figure


class _Looks:
    """Color, marker and fill of each kind."""

    def __init__(self, marks: Sequence[TradeoffMark]) -> None:
        colors, markers, fills = (
            list(dict.fromkeys(kind for kind in kinds if kind))
            for kinds in zip(*(mark.kinds for mark in marks), strict=True)
        )
        self.colors = {one: COLORS[i % len(COLORS)] for i, one in enumerate(colors)}
        order = [*_VARIANTS, *(one for one in markers if one not in _VARIANTS)]
        self.markers = {one: _MARKERS[order.index(one) % len(_MARKERS)] for one in markers}
        self.fills = {one: _FILLS[i % len(_FILLS)] for i, one in enumerate(fills)}

    def of(self, mark: TradeoffMark) -> dict:
        color, marker, fill = mark.kinds
        return self._look(self.colors[color], self.markers[marker], self.fills.get(fill, "full"))

    def legend(self) -> list[list[Line2D]]:
        """Handles of each kind of look."""
        looks = [
            {one: (color, "o", "full") for one, color in self.colors.items()},
            {one: (INK, marker, "full") for one, marker in self.markers.items()},
            {one: (INK, "h", fill) for one, fill in self.fills.items()},
        ]
        return [
            [Line2D([], [], ls="none", label=name, **self._look(*look)) for name, look in kinds.items()]
            for kinds in looks
        ]

    @staticmethod
    def _look(color: str, marker: str, fill: str) -> dict:
        look = {"color": color, "marker": marker, "fillstyle": fill}
        return {**look, "markerfacecoloralt": PAPER, "markersize": 6.5}


def _draw_legend(figure: Figure, looks: _Looks, headings: Sequence[str], axes: Axes) -> None:
    """Add a column next to the charts with a heading per kind of look."""
    handles = []
    for heading, kinds in zip(headings, looks.legend(), strict=True):
        if kinds:
            handles += [Line2D([], [], ls="none", label=heading), *kinds]
    shared = [line for line in axes.get_lines() if line.get_label() in ("full map", "recommended")]
    legend = figure.legend(handles=[*handles, *shared], loc="outside right upper", handletextpad=0.4)
    for text in legend.get_texts():
        if text.get_text() in headings:
            text.set_fontweight("bold")


def _draw_marks(
    axes: Axes, marks: Sequence[TradeoffMark], cost: Callable[[TradeoffMark], float], looks: _Looks
) -> None:
    places = [(cost(mark), mark.accuracy) for mark in marks]
    front = pareto_front(*zip(*places, strict=True))
    steps = np.array([places[i] for i in front])
    axes.plot(*steps.T, drawstyle="steps-post", color=INK, alpha=0.5, lw=1.2, label="front")
    for i, (mark, (x, y)) in enumerate(zip(marks, places, strict=True)):
        look = looks.of(mark)
        if mark.interval:
            ends, alpha = (mark.interval.low, mark.interval.high), 0.6 if i in front else 0.2
            axes.plot([x, x], ends, color=look["color"], alpha=alpha, lw=1.2)
        axes.plot([x], [y], ls="none", label=mark.name, **look)
    if ringed := [place for mark, place in zip(marks, places, strict=True) if mark.is_recommended]:
        axes.plot(*np.array(ringed).T, label="recommended", **_RING)
    axes.set_xscale("log")
    axes.margins(x=0.1)
    axes.grid(visible=True)


def _limits(marks: Sequence[TradeoffMark]) -> tuple[float, float]:
    """Limits of the accuracy, with room for labels."""
    values = [mark.accuracy for mark in marks]
    for mark in marks:
        if mark.interval:
            values += [mark.interval.low, mark.interval.high]
    room = 0.1 * max(max(values) - min(values), 4.0)
    return min(values) - room, max(values) + room


def _label_front(axes: Axes, marks: Sequence[TradeoffMark], cost: Callable[[TradeoffMark], float]) -> None:
    """Label the marks of the front, the most accurate first; labels without space are omitted."""
    places = [(cost(mark), mark.accuracy) for mark in marks]
    figure = axes.get_figure(root=True)
    assert figure is not None
    pixels = figure.dpi / 72
    renderer = FigureCanvasAgg(figure).get_renderer()
    room = axes.get_window_extent(renderer)
    in_pixels = axes.transData.transform(places)
    front = pareto_front(*zip(*places, strict=True))
    taken = [Bbox([place - _MARK_PT * pixels, place + _MARK_PT * pixels]) for place in in_pixels]
    for a, b in pairwise(in_pixels[i] for i in front):
        taken += [_around(a, np.array([b[0], a[1]])), _around(np.array([b[0], a[1]]), b)]
    for i in reversed(front):
        tried = axes.text(0, 0, marks[i].name, fontsize=_LABEL_PT)
        extent = np.array(tried.get_window_extent(renderer).size)
        tried.remove()
        for offset in _OFFSETS:
            corner = in_pixels[i] + pixels * np.array(offset) + extent * (np.sign(offset) - 1) / 2
            box = _around(corner, corner + extent)
            if (
                room.contains(*box.min)
                and room.contains(*box.max)
                and not any(box.overlaps(one) for one in taken)
            ):
                taken.append(box)
                _write(axes, marks[i].name, places[i], offset)
                break


def _around(a: np.ndarray, b: np.ndarray) -> Bbox:
    return Bbox([np.minimum(a, b) - 1, np.maximum(a, b) + 1])


def _write(axes: Axes, text: str, place: tuple[float, float], offset: tuple[float, float]) -> None:
    x, y = np.sign(offset).astype(int).tolist()
    line = {"arrowstyle": "-", "color": INK, "alpha": 0.4, "linewidth": 0.6, "shrinkB": 3, "shrinkA": 1}
    axes.annotate(
        text,
        place,
        xytext=offset,
        textcoords="offset points",
        fontsize=_LABEL_PT,
        ha=("center", "left", "right")[x],
        va=("center", "bottom", "top")[y],
        arrowprops=line if max(map(abs, offset)) > _NEAR_PT else None,
    )
