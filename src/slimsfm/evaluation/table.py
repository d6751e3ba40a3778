"""The paper's table: one row a strategy and variant of the map."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slimsfm.evaluation.metrics import ADD_FRACTIONS, DEG_CM, SURE, Scores
from slimsfm.localization import Seconds


@dataclass(frozen=True, kw_only=True)
class Row:
    """How one strategy does on one variant of a map."""

    object: str
    """Name of the object or scene."""

    strategy: str
    """How queries were matched."""

    variant: str
    """Which map: "full", "dominating" or "random"."""

    references: float | int
    """Reference images of the map; a mean where the variant is one of several draws."""

    points: float | int
    """Points of the map, likewise."""

    map_bytes: float | int
    """Size of the map on disk, likewise."""

    scores: Scores
    """What localizing the queries gave, likewise."""

    def to_json(self) -> dict:
        """The row as plain values, under the names of `results.json`; what has no value is None."""
        scores, seconds = self.scores, self.scores.seconds
        values = {
            "object": self.object,
            "strategy": self.strategy,
            "variant": self.variant,
            "references": self.references,
            "points": self.points,
            "map_bytes": self.map_bytes,
            "queries": scores.queries,
            "localized": scores.localized,
            **{f"add_{fraction}d": scores.add[fraction] for fraction in ADD_FRACTIONS},
            "median_corner_error": _finite(scores.median_corner_error),
            f"confidence_wrong_at_{SURE}": scores.confidence_wrong,
            "references_tried": scores.references_tried,
            "ms_extract": 1e3 * seconds.extract,
            "ms_match": 1e3 * seconds.match,
            "ms_pose": 1e3 * seconds.pose,
            "ms_total": 1e3 * seconds.total,
            "fps": scores.fps,
        }
        if scores.deg_cm is not None:
            values |= {f"{n}deg_{n}cm": scores.deg_cm[n] for n in DEG_CM}
        return values


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def mean_row(rows: Sequence[Row]) -> Row:
    """The mean of several draws of one variant; the medians' median stands for the median."""
    first, scores = rows[0], [row.scores for row in rows]
    seconds = [one.seconds for one in scores]
    metric = all(one.deg_cm is not None for one in scores)
    return Row(
        object=first.object,
        strategy=first.strategy,
        variant=first.variant,
        references=_mean([row.references for row in rows]),
        points=_mean([row.points for row in rows]),
        map_bytes=_mean([row.map_bytes for row in rows]),
        scores=Scores(
            queries=first.scores.queries,
            localized=_mean([one.localized for one in scores]),
            add={fraction: _mean([one.add[fraction] for one in scores]) for fraction in ADD_FRACTIONS},
            median_corner_error=float(np.median([one.median_corner_error for one in scores])),
            deg_cm={n: _mean([(one.deg_cm or {})[n] for one in scores]) for n in DEG_CM} if metric else None,
            confidence_wrong=_mean_of_known([one.confidence_wrong for one in scores]),
            references_tried=_mean([one.references_tried for one in scores]),
            seconds=Seconds(
                extract=_mean([one.extract for one in seconds]),
                match=_mean([one.match for one in seconds]),
                pose=_mean([one.pose for one in seconds]),
            ),
        ),
    )


def _mean(values: Sequence[float | int]) -> float:
    return float(np.mean(values))


def _mean_of_known(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return _mean(known) if known else None
