"""What the page tells of a run, computed once: rows, comparisons, and what its headlines are about."""

from collections.abc import Sequence
from dataclasses import dataclass

from slimsfm.evaluation.comparison import Comparison, MeasurementKey, against_full
from slimsfm.evaluation.results import ObjectResult, Run
from slimsfm.evaluation.table import BY_FRAME, BY_OBJECT, Row, average_rows, rows_of

_HEADLINES = ("default", "dominating")


@dataclass(frozen=True, kw_only=True, eq=False)
class Story:
    """A run and what is computed from it."""

    run: Run
    """The run."""

    rows: dict[str, list[Row]]
    """By object, and by the names of the averages where there are several objects."""

    comparisons: list[Comparison]
    """Every line against the full map, of each object and over all."""

    @property
    def overall(self) -> str:
        """The object of rows and comparisons that speak of the whole run."""
        names = [one.name for one in self.run.objects]
        return BY_FRAME if len(names) > 1 else names[0]

    @property
    def methods(self) -> list[str]:
        """All methods."""
        return list(dict.fromkeys(line.method for one in self.run.objects for line in one.measurements))

    def of(self, name: str) -> list[Comparison]:
        """Every line of an object, or of all of them, against the full map."""
        return [one for one in self.comparisons if one.object == name]

    def headlines(self, name: str) -> list[Comparison]:
        """The lines that headlines are about: what `slimsfm reduce` gives, and the dominating set.

        Where neither was measured, some other line; none where just the full map was.
        """
        found = self.of(name)
        firsts = [next((one for one in found if one.after[2] == kind), None) for kind in _HEADLINES]
        return [one for one in firsts if one] or found[:1]

    def row(self, name: str, key: MeasurementKey) -> Row:
        """The row of a line."""
        return next(row for row in self.rows[name] if (row.method, row.strategy, row.variant) == key)


def story_of(run: Run) -> Story:
    """Compute what the page tells.

    Raises:
        ValueError: The run has no object.
    """
    if not run.objects:
        raise ValueError("run must hold at least one object")
    rows = {one.name: rows_of(one) for one in run.objects}
    return Story(run=run, rows=rows | _averages(run.objects), comparisons=against_full(run.objects))


def _averages(objects: Sequence[ObjectResult]) -> dict[str, list[Row]]:
    rows = average_rows(objects)
    names = (BY_FRAME, BY_OBJECT) if rows else ()
    return {name: [row for row in rows if row.object == name] for name in names}
