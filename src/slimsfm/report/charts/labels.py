"""Labels beside some of the marks of a chart, as many as can be read."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.transforms import Bbox, BboxBase

from slimsfm.report.figures import INK

_NEAR_PT, _FAR_PT = 7.0, 20.0  # between a mark and its label
_WAYS = tuple((x, y) for x, y in product((1, -1, 0), repeat=2) if (x, y) != (0, 0))
_OFFSETS = tuple((x * reach, y * reach) for reach in (_NEAR_PT, _FAR_PT) for x, y in _WAYS)
_ANCHORS = {-1: "right", 0: "center", 1: "left"}
_RISES = {-1: "top", 0: "center", 1: "bottom"}
_MARK_PT = 4.0  # half the side of a mark
_SIZE = 7.5


@dataclass(frozen=True)
class Label:
    """What is to be written beside a mark."""

    text: str
    """The words."""

    x: float
    """Of the mark, in the unit of its axis."""

    y: float
    """Likewise."""


def place_labels(
    axes: Axes,
    labels: Sequence[Label],
    marks: Sequence[tuple[float, float]],
    lines: Sequence[tuple[float, float, float, float]] = (),
) -> None:
    """Write labels where they cover no mark, line or other label; those that find no such place are left out.

    The limits and the layout of the figure must be final.

    Args:
        axes: Of a chart.
        labels: In order of importance.
        marks: Where all marks are.
        lines: Horizontal and vertical ones: x and y of both ends.
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    pixels = figure.dpi / 72
    places = axes.transData.transform(marks)
    taken = [_around(x, y, _MARK_PT * pixels) for x, y in places]
    for line in lines:
        ends = axes.transData.transform([line[:2], line[2:]])
        taken.append(Bbox([ends.min(axis=0) - 1, ends.max(axis=0) + 1]))
    renderer = FigureCanvasAgg(figure).get_renderer()
    room = axes.get_window_extent(renderer)
    for label in labels:
        mark, size = axes.transData.transform((label.x, label.y)), _size(axes, label.text, renderer)
        for offset in _OFFSETS:
            box = _beside(mark + pixels * np.array(offset), offset, size)
            if _holds(room, box) and not any(box.overlaps(one) for one in taken):
                taken.append(box)
                _write(axes, label, offset)
                break


def _around(x: float, y: float, half: float) -> Bbox:
    return Bbox.from_extents(x - half, y - half, x + half, y + half)


def _size(axes: Axes, text: str, renderer: RendererAgg) -> np.ndarray:
    """Width and height of a label in pixels."""
    tried = axes.text(0, 0, text, fontsize=_SIZE)
    extent = tried.get_window_extent(renderer)
    tried.remove()
    return np.array([extent.width, extent.height])


def _beside(place: np.ndarray, offset: tuple[float, float], size: np.ndarray) -> Bbox:
    """What a label covers that leaves its mark in the direction of the offset."""
    low = place + size * (np.sign(offset) - 1) / 2
    return Bbox([low - 1, low + size + 1])


def _holds(room: BboxBase, box: BboxBase) -> bool:
    return bool(np.all(room.min <= box.min) and np.all(box.max <= room.max))


def _write(axes: Axes, label: Label, offset: tuple[float, float]) -> None:
    x, y = np.sign(offset).astype(int).tolist()
    line = {"arrowstyle": "-", "color": INK, "alpha": 0.4, "linewidth": 0.6, "shrinkB": 3, "shrinkA": 1}
    axes.annotate(
        label.text,
        (label.x, label.y),
        xytext=offset,
        textcoords="offset points",
        fontsize=_SIZE,
        ha=_ANCHORS[x],
        va=_RISES[y],
        arrowprops=line if max(map(abs, offset)) > _NEAR_PT else None,
    )
