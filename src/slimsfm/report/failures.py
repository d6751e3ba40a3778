"""Where it fails: the queries that only one of two maps localizes, and wrong poses that are sure."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from slimsfm.evaluation.comparison import Comparison
from slimsfm.evaluation.results import ObjectResult, Outcomes
from slimsfm.evaluation.scores import SURE
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.report.formatting import difference, line_name, percent_of_d, plural
from slimsfm.report.report_data import Story
from slimsfm.report.table import NOTHING, Head, Value, table_html

_MOST = 200  # listed


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one query against one map."""

    error: float
    """Relative to the object; infinite without a pose."""

    confidence: float
    """Probability that the pose is right; NaN without a pose."""

    @property
    def is_right(self) -> bool:
        """Whether the pose counts as right: within the largest share of ADD."""
        return self.error < ADD_FRACTIONS[0]

    @property
    def is_trap(self) -> bool:
        """Whether the pose is wrong and yet sure."""
        return not self.is_right and self.confidence > SURE


@dataclass(frozen=True, kw_only=True)
class Change:
    """A query of which two maps tell differently, or of which the slim one is wrongly sure."""

    object: str
    """The object."""

    line: str
    """Which slim map, and how it was matched."""

    query: str
    """Name of the image file."""

    before: Outcome
    """Against the full map."""

    after: Outcome
    """Against the slim one."""

    @property
    def verdict(self) -> str:
        """What happened to it."""
        words = [
            word for word, holds in (("lost", self.before.is_right), ("gained", self.after.is_right)) if holds
        ]
        return ", ".join([*words, *(["sure but wrong"] if self.after.is_trap else [])])


def changes(result: ObjectResult, line: Comparison) -> list[Change]:
    """The queries that a slim map lost or gained, and those where it is sure but wrong.

    Of several draws of a map the first counts.
    """
    some = [result.measurement(*key) for key in (line.before, line.after)]
    before, after = (one.map_runs[0].outcomes for one in some if one)
    each = [
        Change(
            object=result.name,
            line=line_name(line.after),
            query=query.path.name,
            before=one,
            after=other,
        )
        for query, one, other in zip(result.queries, _each(before), _each(after), strict=True)
    ]
    return [one for one in each if one.before.is_right != one.after.is_right or one.after.is_trap]


def _each(outcomes: Outcomes) -> Iterator[Outcome]:
    for error, confidence in zip(outcomes.error.tolist(), outcomes.confidence.tolist(), strict=True):
        yield Outcome(error=error, confidence=confidence)


def failures_html(story: Story) -> str:
    """The section: for each line that headlines are about how many queries it lost and gained, and which."""
    found = [
        change
        for result in story.run.objects
        for line in story.headlines(result.name)
        for change in changes(result, line)
    ]
    told = "\n".join(f"<p>{escape(_told(line, found))}</p>" for line in story.headlines(story.overall))
    table = _table(found) if found else ""
    return f'<section class="card"><h2>Where it fails</h2>\n{told}\n{table}</section>'


def _told(line: Comparison, found: Sequence[Change]) -> str:
    name = line_name(line.after)
    verdicts = [one.verdict for one in found if one.line == name]
    lost, gained, traps = (sum(kind in one for one in verdicts) for kind in ("lost", "gained", "sure"))
    return (
        f"{name.capitalize()}, against the {line_name(line.before)}: of {line.queries} queries {lost} lost, "
        f"{gained} gained; {difference(line)}. {plural(traps, 'wrong pose')} with confidence over {SURE}."
    )


_HEADS = (
    Head("Object", "which object", is_number=False),
    Head("Map", "which slim map, and how it was matched", is_number=False),
    Head("Query", "the image file", is_number=False),
    Head("What happened", "lost: right before, wrong after; gained: the other way round", is_number=False),
    Head("Error before", "relative to the object, with the full map"),
    Head("Confidence before", "probability that the pose is right, as it was told"),
    Head("Error after", "relative to the object, with the slim map"),
    Head("Confidence after", "probability that the pose is right, as it was told"),
)


def _table(found: Sequence[Change]) -> str:
    """A table of them; of very many the first."""
    lines = [
        [
            *(escape(text) for text in (one.object, one.line, one.query, one.verdict)),
            *(_error(one.before), _confidence(one.before), _error(one.after), _confidence(one.after)),
        ]
        for one in found[:_MOST]
    ]
    more = f'<p class="note">{len(found) - _MOST} more are not listed.</p>' if len(found) > _MOST else ""
    return table_html(_HEADS, lines) + more


def _error(outcome: Outcome) -> Value:
    return Value(percent_of_d(outcome.error), outcome.error if np.isfinite(outcome.error) else None)


def _confidence(outcome: Outcome) -> Value:
    if np.isnan(outcome.confidence):
        return NOTHING
    return Value(f"{outcome.confidence:.2f}", outcome.confidence)
