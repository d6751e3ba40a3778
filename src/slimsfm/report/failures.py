"""Where it fails: queries that only one of two maps localizes, and confident wrong poses."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float64

from slimsfm.errors import ImageError
from slimsfm.evaluation.comparison import Comparison
from slimsfm.evaluation.results import ObjectResult, Outcomes
from slimsfm.evaluation.scores import SURE
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.photos import read_image
from slimsfm.report.formatting import (
    NO_VALUE,
    ColumnHead,
    NumberCell,
    format_count,
    format_difference,
    format_error,
    format_line,
    table_html,
)
from slimsfm.report.frames import QueryFrame, frame_html
from slimsfm.report.report_data import ReportBudget, ReportData

_MAX_ROWS = 200
_CONFIDENT_WRONG = "confident but wrong"


@dataclass(frozen=True, kw_only=True)
class QueryOutcome:
    """Outcome of one query with one map."""

    error: float
    """Relative to the object; infinite without a pose."""

    confidence: float
    """Probability that the pose is right; NaN without a pose."""

    @property
    def is_right(self) -> bool:
        """Whether the error is below the largest ADD threshold."""
        return self.error < ADD_FRACTIONS[0]

    @property
    def is_confident_wrong(self) -> bool:
        """Whether the pose is wrong in spite of a high confidence."""
        return not self.is_right and self.confidence > SURE


@dataclass(frozen=True, kw_only=True)
class QueryChange:
    """A query that a reduced map lost, gained, or localizes confidently but wrongly."""

    object: str
    """Name of the object."""

    line: str
    """Reduced map and strategy."""

    query: str
    """Name of the image file."""

    before: QueryOutcome
    """With the full map."""

    after: QueryOutcome
    """With the reduced map."""

    @property
    def verdict(self) -> str:
        """What happened to the query."""
        parts = {
            "lost": self.before.is_right and not self.after.is_right,
            "gained": self.after.is_right and not self.before.is_right,
            _CONFIDENT_WRONG: self.after.is_confident_wrong,
        }
        return ", ".join(part for part, holds in parts.items() if holds)


def query_changes(result: ObjectResult, comparison: Comparison) -> list[QueryChange]:
    """The queries that a reduced map lost, gained, or localizes confidently but wrongly.

    Of several random draws of a map the first one counts.
    """
    before, after = _compared(result, comparison)
    each = [
        QueryChange(
            object=result.name,
            line=format_line(comparison.after),
            query=query.path.name,
            before=one,
            after=other,
        )
        for query, one, other in zip(result.queries, _each(before), _each(after), strict=True)
    ]
    return [one for one in each if one.verdict]


def _compared(result: ObjectResult, comparison: Comparison) -> tuple[Outcomes, Outcomes]:
    """Outcomes of an object's queries before and after, in the first draw of each map."""
    before, after = (
        cell.map_runs[0].outcomes
        for key in (comparison.before, comparison.after)
        if (cell := result.measurement(*key))
    )
    return before, after


def _each(outcomes: Outcomes) -> Iterator[QueryOutcome]:
    for error, confidence in zip(outcomes.error.tolist(), outcomes.confidence.tolist(), strict=True):
        yield QueryOutcome(error=error, confidence=confidence)


def failures_html(data: ReportData) -> str:
    """The section: how many queries each headline's map lost and gained, and a table of these queries."""
    found = [
        change
        for result in data.run.objects
        for comparison in data.headlines(result.name)
        for change in query_changes(result, comparison)
    ]
    summaries = [_summary(one, found) for one in data.headlines(data.overall)]
    said = "\n".join(f"<p>{escape(one)}</p>" for one in summaries)
    table = _table(found) if found else ""
    return f'<section class="card"><h2>Where it fails</h2>\n{said}\n{table}</section>'


def _summary(comparison: Comparison, found: Sequence[QueryChange]) -> str:
    verdicts = [one.verdict for one in found if one.line == format_line(comparison.after)]
    lost, gained, wrong = (
        sum(kind in one for one in verdicts) for kind in ("lost", "gained", _CONFIDENT_WRONG)
    )
    name = f"{format_line(comparison.after).capitalize()}, compared with the {format_line(comparison.before)}"
    queries = format_count(comparison.queries, "query")
    if not verdicts:
        return f"{name}: none of {queries} lost or gained."
    parts = [f"{lost} lost" * bool(lost), f"{gained} gained" * bool(gained)]
    changed = ", ".join(part for part in parts if part) or "none lost or gained"
    confident = f" {format_count(wrong, 'wrong pose')} with a confidence above {SURE}." if wrong else ""
    return f"{name}: of {queries} {changed}; {format_difference(comparison)}.{confident}"


_HEADS = (
    ColumnHead("Object", "name of the object", is_number=False),
    ColumnHead("Map", "reduced map and strategy", is_number=False),
    ColumnHead("Query", "image file", is_number=False),
    ColumnHead("Outcome", "lost: right with the full map only; gained: vice versa", is_number=False),
    ColumnHead("Error before", "relative to the object, with the full map"),
    ColumnHead("Confidence before", "estimated probability that the pose is right, with the full map"),
    ColumnHead("Error after", "relative to the object, with the reduced map"),
    ColumnHead("Confidence after", "estimated probability that the pose is right, with the reduced map"),
)


def _table(found: Sequence[QueryChange]) -> str:
    lines = [
        [
            *(escape(text) for text in (one.object, one.line, one.query, one.verdict)),
            *(_error(one.before), _confidence(one.before), _error(one.after), _confidence(one.after)),
        ]
        for one in found[:_MAX_ROWS]
    ]
    omitted = len(found) - _MAX_ROWS
    note = f'<p class="note">{format_count(omitted, "more query")} not listed.</p>' if omitted > 0 else ""
    return table_html(_HEADS, lines) + note


def _error(outcome: QueryOutcome) -> NumberCell:
    return NumberCell(format_error(outcome.error), outcome.error if np.isfinite(outcome.error) else None)


def _confidence(outcome: QueryOutcome) -> NumberCell:
    if np.isnan(outcome.confidence):
        return NO_VALUE
    return NumberCell(f"{outcome.confidence:.2f}", outcome.confidence)


def worst_and_others(errors: Float64[np.ndarray, " n"], count: int) -> list[int]:
    """Indices of `count` queries: the worst half in descending order, the others evenly spaced."""
    order = np.argsort(-errors, kind="stable")
    if len(errors) <= count:
        return order.tolist()
    worst = order[: (count + 1) // 2]
    others = np.setdiff1d(np.arange(len(errors)), worst)
    spaced = others[np.linspace(0, len(others) - 1, count - len(worst)).round().astype(np.int64)]
    return [*worst.tolist(), *spaced.tolist()]


def queries_html(result: ObjectResult, comparison: Comparison, budget: ReportBudget) -> str:
    """Some queries with the object's box at the pose that the reduced map gives."""
    before, after = _compared(result, comparison)
    shown = worst_and_others(after.error, budget.frames)
    frames = list(_frames(result, before, after, shown))
    if not frames:
        return '<h3>Queries</h3>\n<p class="note">The query images are not available anymore.</p>'
    figures = "\n".join(frame_html(one, result.box, budget.frame_px) for one in frames)
    return f"""<h3>Queries</h3>
<p class="note">{format_line(comparison.after).capitalize()}: the worst first, then others evenly spaced.
<span class="estimated">Red</span>: the box at the estimated pose.
<span class="true">Green</span>: at the true pose.</p>
<div class="frames">
{figures}
</div>"""


def _frames(
    result: ObjectResult, before: Outcomes, after: Outcomes, shown: Sequence[int]
) -> Iterator[QueryFrame]:
    for i in shown:
        query = result.queries[i]
        try:
            image = read_image(query.path, query.orientation)
        except ImageError:
            continue
        yield QueryFrame(
            image=image,
            camera=query.camera,
            estimated_cam_from_world=after.cam_from_world[i],
            true_cam_from_world=query.cam_from_world,
            label=query.path.name,
            verdict=_caption(before, after, i),
        )


def _caption(before: Outcomes, after: Outcomes, i: int) -> str:
    text = format_error(after.error[i])
    if np.isfinite(after.error[i]):
        text = f"error {text}, confidence {after.confidence[i]:.2f}"
    return f"{text} (full map: {format_error(before.error[i])})"
