"""What many outcomes come to."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from slimsfm.evaluation.metrics import DEG_CM, add_percent, deg_cm_percent, within_deg_cm, wrong_when_sure
from slimsfm.evaluation.outcomes import Outcomes
from slimsfm.geometry import ADD_FRACTIONS
from slimsfm.localization import Seconds

Share = Callable[[Outcomes], Bool[np.ndarray, " n"]]
"""Which queries fulfil a criterion."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """What localizing many queries gave. Percentages are of all queries."""

    queries: int
    """How many there were."""

    localized: float
    """Percentage with a pose, right or wrong."""

    add: dict[float, float]
    """Percentage within each of `ADD_FRACTIONS` of the diagonal."""

    median_error: float
    """Relative; infinite unless more than half are localized."""

    deg_cm: dict[int, float] | None
    """Percentage within n degrees and n cm for each of `DEG_CM`; None where the unit is unknown."""

    confidence_wrong: float | None
    """Share of wrong poses, off by a tenth of the diagonal or more, among those that are sure; None where no
    pose is."""

    references_tried: float
    """Reference images that a query was matched with, on average."""

    seconds: Seconds
    """Mean time a query."""

    @property
    def fps(self) -> float:
        """Queries a second, all stages together."""
        return 1 / self.seconds.total


def score(outcomes: Outcomes, *, metric: bool, trials: int = 1) -> Scores:
    """Sum up outcomes.

    Args:
        outcomes: What became of the queries.
        metric: Whether the unit of the map is the metre.
        trials: How often each query is among them.
    """
    extract, match, pose = outcomes.seconds.mean(axis=0).tolist()
    return Scores(
        queries=len(outcomes) // trials,
        localized=100 * float(np.mean(np.isfinite(outcomes.error))),
        add={fraction: add_percent(outcomes.error, fraction) for fraction in ADD_FRACTIONS},
        median_error=float(np.median(outcomes.error)),
        deg_cm={n: deg_cm_percent(outcomes.rotation_deg, outcomes.translation, n) for n in DEG_CM}
        if metric
        else None,
        confidence_wrong=wrong_when_sure(outcomes.error, outcomes.confidence, ADD_FRACTIONS[0]),
        references_tried=float(np.mean(outcomes.references)),
        seconds=Seconds(extract=extract, match=match, pose=pose),
    )


def shares(*, metric: bool) -> dict[str, Share]:
    """The criteria by their names in `results.json`, whose shares are percentages of the table."""
    found: dict[str, Share] = {"localized": lambda one: np.isfinite(one.error)}
    found |= {f"add_{fraction}d": _closer_than(fraction) for fraction in ADD_FRACTIONS}
    return found | ({f"{n}deg_{n}cm": _within(n) for n in DEG_CM} if metric else {})


def _closer_than(fraction: float) -> Share:
    return lambda one: one.error < fraction


def _within(n: int) -> Share:
    return lambda one: within_deg_cm(one.rotation_deg, one.translation, n)


def mean_scores(scores: Sequence[Scores]) -> Scores:
    """The mean over objects, each counting alike; the medians' median stands for the median."""
    seconds = [one.seconds for one in scores]
    metric = all(one.deg_cm is not None for one in scores)
    return Scores(
        queries=sum(one.queries for one in scores),
        localized=_mean([one.localized for one in scores]),
        add={fraction: _mean([one.add[fraction] for one in scores]) for fraction in ADD_FRACTIONS},
        median_error=float(np.median([one.median_error for one in scores])),
        deg_cm={n: _mean([(one.deg_cm or {})[n] for one in scores]) for n in DEG_CM} if metric else None,
        confidence_wrong=_mean_of_known([one.confidence_wrong for one in scores]),
        references_tried=_mean([one.references_tried for one in scores]),
        seconds=Seconds(
            extract=_mean([one.extract for one in seconds]),
            match=_mean([one.match for one in seconds]),
            pose=_mean([one.pose for one in seconds]),
        ),
    )


def _mean(values: Sequence[float | int]) -> float:
    return float(np.mean(values))


def _mean_of_known(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return _mean(known) if known else None
