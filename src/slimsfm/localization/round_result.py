"""What a round of matching gave, and whether another one is needed."""

from dataclasses import dataclass

import pycolmap

from slimsfm.localization.evidence import Evidence
from slimsfm.localization.strategy import PointMatches, Query
from slimsfm.pose import PoseEstimate

SURE = 0.95
"""Confidence from which a pose is sure."""

MIN_REFUTING = 2
"""Number of images that could have contradicted an ambiguous pose, before the search may stop."""

ACCURATE = 0.007
"""Predicted relative corner error up to which a pose is accurate."""

SPREAD = 10
"""Number of squares of the image in which inliers of an accurate pose must lie."""

SETTLED = 0.8
"""Share of the previous round's predicted error above which further matches no longer help much."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RoundResult:
    """Result of one round."""

    query: Query
    """The features that were matched."""

    matches: PointMatches
    """All matches of these features so far."""

    pose: PoseEstimate | None
    """The pose estimated from them, with its confidence."""

    camera: pycolmap.Camera
    """The intrinsics, with the estimated focal length if it was not known."""

    evidence: Evidence | None
    """What the confidence is computed from; None if there is no pose."""

    match_seconds: float
    """Wall time of matching in this round."""

    pose_seconds: float
    """Wall time of estimating and verifying the pose."""

    @property
    def confidence(self) -> float:
        """Confidence of the pose; below zero if there is none."""
        return -1.0 if self.pose is None else self.pose.confidence or 0.0

    def doubt(self, min_confidence: float) -> str | None:
        """Why there is no pose of at least this confidence; None if there is one."""
        if self.pose is None:
            count = len(self.matches.points)
            return f"no pose agrees with enough of {count} matches" if count else "no matches with the map"
        if self.confidence < min_confidence:
            return f"the confidence {self.confidence:.2f} is below {min_confidence:g}"
        return None


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchResult:
    """The round that counts, and what all rounds took."""

    best: RoundResult
    """The last round with a pose: it has all matches of the rounds before with the same features, and any
    that contradict them."""

    references: int
    """Number of reference images that the query was matched with."""

    match_seconds: float
    """Wall time of matching."""

    pose_seconds: float
    """Wall time of estimating and verifying poses."""


def suffices(rounds: list[RoundResult], *, is_coarse: bool = False) -> bool:
    """Whether the last pose is sure, and not improving much, or accurate by inliers all over the object.

    Inliers in one corner may agree with each other more exactly than with the rest, as repeated texture does.

    Args:
        rounds: The rounds so far.
        is_coarse: Whether features of a larger image are the alternative.
    """
    last = rounds[-1].evidence
    if last is None or (last.confidence_in_matches if is_coarse else last.confidence) < SURE:
        return False
    is_same_image = len(rounds) > 1 and rounds[-2].query is rounds[-1].query
    before = rounds[-2].evidence if is_same_image else None
    settled = before is not None and last.predicted_error > SETTLED * before.predicted_error
    return settled or (last.predicted_error <= ACCURATE and last.cells >= SPREAD)


def needs_refuting(last: RoundResult) -> bool:
    """Whether a pose is ambiguous and more images could contradict it."""
    is_ambiguous = last.evidence is not None and last.evidence.is_ambiguous
    return is_ambiguous and last.matches.references < MIN_REFUTING


def summed(rounds: list[RoundResult]) -> SearchResult:
    """The last round with a pose, and what all rounds took."""
    return SearchResult(
        best=next((one for one in reversed(rounds) if one.pose), rounds[-1]),
        references=max(one.matches.references for one in rounds),
        match_seconds=sum(one.match_seconds for one in rounds),
        pose_seconds=sum(one.pose_seconds for one in rounds),
    )
