"""What reducing a map gained and cost, in words."""

from collections.abc import Sequence

from slimsfm.evaluation.table import Row
from slimsfm.mapping.map import Map


def number(value: float | int) -> str:
    """A count, or a mean of counts, with its thousands marked."""
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:,.1f}"


def size(num_bytes: float | int) -> str:
    """A size on disk in the unit that suits it; 1 kB is 1000 bytes."""
    value, units = float(num_bytes), ["B", "kB", "MB", "GB"]
    while value >= 999.5 and len(units) > 1:
        value, units = value / 1000, units[1:]
    return f"{value:.1f} {units[0]}" if value < 10 and units[0] != "B" else f"{value:.0f} {units[0]}"


def contents(map: Map) -> str:
    """How much a map holds."""
    images, points = len(map.images), f"{number(len(map.point3D_ids))} points"
    if map.is_for_direct_matching:
        return points
    return f"{number(images)} image{'s' * (images != 1)}, {points}"


def headline(full: Map, reduced: Map, rows: Sequence[Row]) -> str:
    """One sentence: what became of the map, its accuracy and its speed.

    Accuracy, speed and size are left out where the rows do not tell them for both maps.
    """
    pair = compared(rows)
    if pair is None:
        return f"{contents(full)} → {contents(reduced)}."
    before, after = pair
    add = [f"{row.scores.add[0.1]:.1f} %" for row in pair]
    return (
        f"{contents(full)}, {size(before.map_bytes)} → {contents(reduced)}, {size(after.map_bytes)}; "
        f"ADD-0.1d {add[0]} → {add[1]}, matching and pose {_speed(before, after)}."
    )


def compared(rows: Sequence[Row]) -> tuple[Row, Row] | None:
    """The full map's row and that of the slim map, or None.

    What `slimsfm reduce` gives by itself, for direct matching, stands against the full map matched
    exhaustively; where it was not measured, dominating images against the full map under the same strategy.
    """
    by_label = {(row.strategy, row.variant): row for row in rows}
    pairs = [(("exhaustive", "full"), ("direct", "default"))]
    pairs += [((row.strategy, "full"), (row.strategy, "dominating")) for row in rows]
    for before, after in pairs:
        if before in by_label and after in by_label:
            return by_label[before], by_label[after]
    return None


def _speed(before: Row, after: Row) -> str:
    old, new = (row.scores.seconds.match + row.scores.seconds.pose for row in (before, after))
    if old <= 0 or new <= 0:
        return "not timed"
    return _ratio(old / new, "faster") if old >= new else _ratio(new / old, "slower")


def _ratio(ratio: float, word: str) -> str:
    rounded = f"{ratio:.0f}" if ratio >= 10 else f"{ratio:.1f}"
    return "equally fast" if rounded == "1.0" else f"{rounded}\N{MULTIPLICATION SIGN} {word}"
