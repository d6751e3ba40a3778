"""What reducing a map gained and cost, in words."""

from collections.abc import Sequence
from math import isfinite

from slimsfm.evaluation.comparison import Comparison, MeasurementKey
from slimsfm.evaluation.formats import format_p_value
from slimsfm.evaluation.results import MappedObject
from slimsfm.evaluation.table import format_bytes, format_number
from slimsfm.mapping.map import Map

__all__ = [
    "contents",
    "difference",
    "domination",
    "format_bytes",
    "format_number",
    "gain",
    "line_name",
    "percent_of_d",
    "plural",
    "ratio",
]

_EQUAL = "1.0"


def plural(count: int, word: str) -> str:
    """A count and what it counts."""
    words = f"{word[:-1]}ies" if word.endswith("y") else f"{word}s"
    return f"{format_number(count)} {word if count == 1 else words}"


def contents(map: Map) -> str:
    """How much a map holds."""
    points = plural(len(map.point3D_ids), "point")
    return points if map.is_for_direct_matching else f"{plural(len(map.images), 'image')}, {points}"


def line_name(key: MeasurementKey, methods: Sequence[str] = ()) -> str:
    """A line of the table: map and strategy, and where there are several methods which one."""
    method, strategy, variant = key
    name = f"{variant} map, {strategy}"
    return f"{name}, with {method}" if len(methods) > 1 else name


def gain(one: Comparison) -> str:
    """One sentence on a slim map: what it saves, and what accuracy that costs."""
    return (
        f"{ratio(one.smaller, 'smaller', 'larger')}, {ratio(one.faster, 'faster', 'slower')}; "
        f"ADD-0.1d {one.add_before:.1f} % → {one.add_after:.1f} %"
    )


def difference(one: Comparison) -> str:
    """How sure the change in accuracy is: a 95 % interval, and the probability that it is chance."""
    return (
        f"difference {_signed(one.add_gain.low)} to {_signed(one.add_gain.high)} points, "
        f"p {format_p_value(one.p_value)}"
    )


def _signed(value: float) -> str:
    return f"{value:+.1f}".replace("-", "\N{MINUS SIGN}")


def ratio(value: float, more: str, less: str) -> str:
    """How many times more or less, to two digits."""
    if value < 1:
        value, more = 1 / value, less
    rounded = f"{value:.0f}" if value >= 10 else f"{value:.1f}"
    return f"equally {_STEMS[more]}" if rounded == _EQUAL else f"{rounded}\N{MULTIPLICATION SIGN} {more}"


_STEMS = {"smaller": "small", "larger": "large", "faster": "fast", "slower": "fast"}


def domination(mapped: MappedObject) -> str:
    """One sentence on an object's dominating set."""
    count = len(mapped.dominating_set)
    least = "no fewer can" if mapped.lower_bound >= count else f"no fewer than {mapped.lower_bound} can"
    return (
        f"{format_number(count)} of {plural(mapped.references, 'image')} dominate the others ({least}); "
        f"they see {format_number(mapped.dominating_points)} of {plural(mapped.points, 'point')}."
    )


def percent_of_d(error: float) -> str:
    """A relative error, or that there is no pose."""
    return (
        f"{100 * error:.1f}\N{NO-BREAK SPACE}% of\N{NO-BREAK SPACE}d" if isfinite(error) else "not localized"
    )
