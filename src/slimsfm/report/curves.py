"""Curves of a frontier as SVG: what is lost and how long a query takes, over the size of the map."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from math import ceil, floor, log10

from slimsfm.reduction import Candidate, Frontier

_WIDTH, _HEIGHT, _MARGIN = 420.0, 320.0, 56.0
_MANY_DECADES = 4
_COLORS = ("#0b6e99", "#c4501b", "#3d8b37", "#7a4fa3", "#8a6d00")


@dataclass(frozen=True, kw_only=True)
class _Axis:
    """Maps values to pixels, in logarithms or not."""

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool

    def at(self, value: float) -> float:
        low, high, value = (log10(one) if self.logarithmic else one for one in (self.low, self.high, value))
        return self.start + (self.end - self.start) * (value - low) / max(high - low, 1e-12)

    def ticks(self) -> list[float]:
        if self.logarithmic:
            decades = [10.0**one for one in range(floor(log10(self.low)), ceil(log10(self.high)) + 1)]
            steps = (1, 2, 5) if len(decades) < _MANY_DECADES else (1,)
            return [k * one for one in decades for k in steps if self.low <= k * one <= self.high]
        step = 10.0 ** floor(log10(max(self.high - self.low, 1e-12)))
        return [step * one for one in range(ceil(self.low / step), floor(self.high / step) + 1)]


def draw_curves(frontier: Frontier, recommended: Mapping[str, Candidate], full_bytes: int) -> str:
    """Draw two charts side by side: loss over bytes and time over bytes, a curve a use and method.

    Args:
        frontier: What was tried.
        recommended: By use; drawn with a ring.
        full_bytes: Size of the full map.
    """
    chosen = list(recommended.values())
    charts = (
        ("points lost against the full map (%)", lambda one: one.loss, False),
        ("matching + pose a query (ms)", lambda one: max(1e3 * one.seconds, 1e-3), True),
    )
    drawn = [
        f'<g transform="translate({number * _WIDTH} 0)">'
        + _chart(frontier, chosen, full_bytes, title, value, logarithmic)
        + "</g>"
        for number, (title, value, logarithmic) in enumerate(charts)
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * _WIDTH} {_HEIGHT + 40}" '
        'font-family="sans-serif" font-size="11">'
        f'<rect width="100%" height="100%" fill="#fff"/>{"".join(drawn)}{_legend(frontier)}</svg>\n'
    )


def _chart(
    frontier: Frontier,
    chosen: list[Candidate],
    full_bytes: int,
    title: str,
    value: Callable[[Candidate], float],
    logarithmic: bool,
) -> str:
    values = [value(one) for one in frontier.candidates]
    sizes = [one.bytes for one in frontier.candidates]
    low, high = (
        (min(values) / 1.3, max(values) * 1.3) if logarithmic else (min(0.0, *values), max(values) + 1)
    )
    x = _Axis(low=min(sizes) / 1.3, high=1.3 * full_bytes, start=_MARGIN, end=_WIDTH - 12, logarithmic=True)
    y = _Axis(low=low, high=high, start=_HEIGHT - 36, end=28.0, logarithmic=logarithmic)
    parts = [f'<text x="{_MARGIN}" y="16" font-weight="bold">{title}</text>', _grid(x, y)]
    for series, color in _series(frontier):
        places = [(x.at(float(one.bytes)), y.at(value(one))) for one in series]
        line = " ".join(f"{a:.1f},{b:.1f}" for a, b in places)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="1.5"/>')
        for one, (a, b) in zip(series, places, strict=True):
            parts.append(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2.5" fill="{color}"/>')
            if any(one is best for best in chosen):
                parts.append(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="7" fill="none" stroke="#000"/>')
    return "".join(parts)


def _grid(x: _Axis, y: _Axis) -> str:
    parts = []
    for tick in x.ticks():
        at = x.at(tick)
        parts.append(f'<path d="M{at:.1f} {y.start}V{y.end}" stroke="#ddd"/>')
        parts.append(f'<text x="{at:.1f}" y="{y.start + 14}" text-anchor="middle">{_bytes(tick)}</text>')
    for tick in y.ticks():
        at = y.at(tick)
        parts.append(f'<path d="M{x.start} {at:.1f}H{x.end}" stroke="#ddd"/>')
        parts.append(f'<text x="{x.start - 6}" y="{at + 4:.1f}" text-anchor="end">{tick:g}</text>')
    return "".join(parts)


def _bytes(value: float) -> str:
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:g} {unit}"
        value /= 1000
    return f"{value:g} GB"


def _series(frontier: Frontier) -> list[tuple[list[Candidate], str]]:
    """The candidates of each use and method by size, and their colour."""
    names = sorted({_name(one) for one in frontier.candidates})
    return [
        (
            sorted((one for one in frontier.candidates if _name(one) == name), key=lambda one: one.bytes),
            _COLORS[number % len(_COLORS)],
        )
        for number, name in enumerate(names)
    ]


def _name(one: Candidate) -> str:
    return f"{one.choice.use}: {one.choice.method}"


def _legend(frontier: Frontier) -> str:
    parts = []
    for number, (series, color) in enumerate(_series(frontier)):
        left = _MARGIN + number * 160
        parts.append(f'<circle cx="{left}" cy="{_HEIGHT + 16}" r="4" fill="{color}"/>')
        parts.append(f'<text x="{left + 10}" y="{_HEIGHT + 20}">{escape(_name(series[0]))}</text>')
    parts.append(f'<text x="{_MARGIN}" y="{_HEIGHT + 36}" fill="#555">ring: recommended</text>')
    return "".join(parts)
