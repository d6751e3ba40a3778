"""Accuracy over size and time of everything that a benchmark tried."""

from collections.abc import Callable, Sequence
from itertools import pairwise

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from slimsfm.evaluation.table import Row, format_bytes
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.report.charts.labels import Label, place_labels
from slimsfm.report.figures import COLORS, INK, PAPER, mark_logarithmic, new_figure, styled

_MARKERS = ("s", "o", "D", "^", "v", "P", "X", "p", "h", "<", ">")
_FIRST_MARKERS = {"full": "s", "dominating": "o", "default": "D", "random": "^"}
_FILLS = ("full", "none", "left", "top", "right", "bottom")
_LEAST_MS = 1e-3  # on the axis of times
_ADD = f"add_{ADD_FRACTIONS[0]}d"


def pareto(costs: Sequence[float], gains: Sequence[float]) -> list[int]:
    """Which of several things nothing else beats: by cost, which only goes up with gain.

    Of equal ones the first is taken.
    """
    front: list[int] = []
    for i in sorted(range(len(costs)), key=lambda i: (costs[i], -gains[i], i)):
        if not front or gains[i] > gains[front[-1]]:
            front.append(i)
    return front


def frontier_chart(rows: Sequence[Row]) -> Figure:
    """Accuracy over the size of the map and over the time of a query, with what nothing else beats joined.

    Args:
        rows: Of one object, or of one average over objects.

    Raises:
        ValueError: There is no row.
    """
    if not rows:
        raise ValueError("rows must hold at least one row")
    with styled():
        figure = new_figure(9.6, 4.2, "Accuracy over size of the map and over time of a query")
        by_size, by_time = figure.subplots(1, 2, sharey=True)
        looks = _Looks(rows)
        _draw_rows(by_size, rows, _bytes, looks)
        _draw_rows(by_time, rows, _milliseconds, looks)
        by_size.set_xlabel("size of the map (logarithmic)")
        by_time.set_xlabel("matching + pose, ms a query (logarithmic)")
        by_size.set_ylabel(f"ADD-{ADD_FRACTIONS[0]}d: queries localized (%)")
        by_size.set_yticks([tick for tick in by_size.get_yticks() if 0 <= tick <= 100])
        by_size.set_ylim(*_limits(rows))
        mark_logarithmic(by_size.xaxis, format_bytes)
        mark_logarithmic(by_time.xaxis, lambda value: f"{value:g}")
        _draw_legend(figure, looks)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # labels are placed in this layout
        _label_front(by_size, rows, _bytes)
        _label_front(by_time, rows, _milliseconds)
    return figure


def _bytes(row: Row) -> float:
    return float(row.map_bytes)


def _milliseconds(row: Row) -> float:
    return max(1e3 * (row.scores.seconds.match + row.scores.seconds.pose), _LEAST_MS)


def _accuracy(row: Row) -> float:
    return row.scores.add[ADD_FRACTIONS[0]]


class _Looks:
    """Colours tell strategies, markers variants and their filling methods."""

    def __init__(self, rows: Sequence[Row]) -> None:
        strategies, variants, methods = (
            list(dict.fromkeys(getattr(row, name) for row in rows))
            for name in ("strategy", "variant", "method")
        )
        self.colors = {one: COLORS[i % len(COLORS)] for i, one in enumerate(strategies)}
        spare = [one for one in _MARKERS if one not in _FIRST_MARKERS.values()]
        others = [one for one in variants if one not in _FIRST_MARKERS]
        self.markers = {
            one: _FIRST_MARKERS.get(one) or spare[others.index(one) % len(spare)] for one in variants
        }
        self.fills = {one: _FILLS[i % len(_FILLS)] for i, one in enumerate(methods)}

    def of(self, row: Row) -> dict:
        return self._marker(self.markers[row.variant], self.fills[row.method], self.colors[row.strategy])

    def legend(self) -> dict[str, list[Line2D]]:
        """Marks by what they tell of, with their names."""
        shown = {
            "strategy": [(one, "o", "full", color) for one, color in self.colors.items()],
            "map": [(one, marker, "full", INK) for one, marker in self.markers.items()],
            "method": [(one, "h", fill, INK) for one, fill in self.fills.items()],
        }
        return {
            what: [Line2D([], [], ls="none", label=one, **self._marker(*look)) for one, *look in kinds]
            for what, kinds in shown.items()
            if what != "method" or len(kinds) > 1
        }

    @staticmethod
    def _marker(marker: str, fill: str, color: str) -> dict:
        return {
            "marker": marker,
            "fillstyle": fill,
            "color": color,
            "markerfacecoloralt": PAPER,
            "markersize": 6.5,
        }


def _draw_legend(figure: Figure, looks: _Looks) -> None:
    """A column beside the charts, with a heading for each kind of mark."""
    handles = []
    for what, marks in looks.legend().items():
        handles += [Line2D([], [], ls="none", label=what), *marks]
    legend = figure.legend(handles=handles, loc="outside right upper", handletextpad=0.4)
    for text in legend.get_texts():
        if text.get_text() in looks.legend():
            text.set_fontweight("bold")


def _draw_rows(axes: Axes, rows: Sequence[Row], cost: Callable[[Row], float], looks: _Looks) -> None:
    costs, gains = [cost(row) for row in rows], [_accuracy(row) for row in rows]
    front = pareto(costs, gains)
    axes.plot(
        [costs[i] for i in front],
        [gains[i] for i in front],
        drawstyle="steps-post",
        color=INK,
        alpha=0.5,
        lw=1.2,
        label="front",
    )
    for i, (row, x, y) in enumerate(zip(rows, costs, gains, strict=True)):
        look = looks.of(row)
        if interval := row.intervals.get(_ADD):
            alpha = 0.6 if i in front else 0.2
            axes.plot([x, x], [interval.low, interval.high], color=look["color"], alpha=alpha, lw=1.2)
        axes.plot([x], [y], ls="none", label=_name(row), **look)
    axes.set_xscale("log")
    axes.margins(x=0.1)
    axes.grid(visible=True)


def _name(row: Row) -> str:
    return f"{row.method} {row.strategy} {row.variant}"


def _limits(rows: Sequence[Row]) -> tuple[float, float]:
    """Of the accuracies, with room for labels above and below."""
    values = [_accuracy(row) for row in rows]
    for row in rows:
        if interval := row.intervals.get(_ADD):
            values += [interval.low, interval.high]
    room = 0.1 * max(max(values) - min(values), 4.0)
    return max(min(values) - room, -4.0), max(values) + room


def _label_front(axes: Axes, rows: Sequence[Row], cost: Callable[[Row], float]) -> None:
    marks = [(cost(row), _accuracy(row)) for row in rows]
    several = len({row.method for row in rows}) > 1
    labels = []
    front = pareto(*zip(*marks, strict=True))
    lines = []
    for (x, y), (next_x, next_y) in pairwise(marks[i] for i in front):
        lines += [(x, y, next_x, y), (next_x, y, next_x, next_y)]
    for i in reversed(front):
        words = f"{rows[i].method}, " if several else ""
        labels.append(Label(f"{words}{rows[i].strategy}, {rows[i].variant}", *marks[i]))
    place_labels(axes, labels, marks, lines)
