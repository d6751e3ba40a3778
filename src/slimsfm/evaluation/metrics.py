"""How good poses are: the paper's metrics, per query and over many."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from slimsfm.geometry import ADD_FRACTIONS, Box, corner_error, rotation_error_deg, translation_error
from slimsfm.localization import Localization, Seconds
from slimsfm.localization.verification import RIGHT

DEG_CM = (1, 3, 5)
"""n of n degrees - n cm."""

SURE = 0.9
"""Confidence over which a pose is taken for right."""


@dataclass(frozen=True, kw_only=True)
class PoseError:
    """How far a pose is from the true one; everything is infinite where there is no pose."""

    relative_corner_error: float
    """Mean distance of the box's corners under the two poses, over the diagonal."""

    rotation_deg: float
    """Angle between the two."""

    translation: float
    """Distance between where the two put the origin before the camera, in map units."""


NO_POSE = PoseError(relative_corner_error=np.inf, rotation_deg=np.inf, translation=np.inf)
"""A query that could not be localized counts as infinitely wrong."""


def pose_error(
    estimated_cam_from_world: pycolmap.Rigid3d | None, true_cam_from_world: pycolmap.Rigid3d, box: Box
) -> PoseError:
    """Compare an estimated pose with the true one."""
    if estimated_cam_from_world is None:
        return NO_POSE
    return PoseError(
        relative_corner_error=corner_error(estimated_cam_from_world, true_cam_from_world, box),
        rotation_deg=rotation_error_deg(estimated_cam_from_world, true_cam_from_world),
        translation=translation_error(estimated_cam_from_world, true_cam_from_world),
    )


def add_percent(errors: Sequence[PoseError], fraction: float) -> float:
    """Modified ADD: percentage of poses whose relative corner error is below a fraction of the diagonal.

    The paper replaces the mean distance of a model's points by that of the box's corners and calls the box's
    longest diagonal the diameter d; with fraction 0.1 this is its ADD-0.1d.
    """
    return 100 * float(np.mean([error.relative_corner_error < fraction for error in errors]))


def deg_cm_percent(errors: Sequence[PoseError], n: int) -> float:
    """Percentage of poses within n degrees and n cm; the map's unit must be the metre."""
    return 100 * float(
        np.mean([error.rotation_deg <= n and 100 * error.translation <= n for error in errors])
    )


def confidence_wrong(errors: Sequence[PoseError], localizations: Sequence[Localization]) -> float | None:
    """Share of wrong poses among those whose confidence is over `SURE`; None where there is no such pose.

    Confidence is the probability that the corner error is below a tenth of the diagonal, so a tenth of the
    poses, at most, should be wrong.
    """
    sure = [
        error.relative_corner_error
        for error, one in zip(errors, localizations, strict=True)
        if one.pose and (one.pose.confidence or 0) > SURE
    ]
    return float(np.mean(np.array(sure) >= RIGHT)) if sure else None


@dataclass(frozen=True, kw_only=True)
class Scores:
    """What localizing many queries gave. Percentages are of all queries."""

    queries: int
    """How many there were."""

    localized: float
    """Percentage with a pose, right or wrong."""

    add: dict[float, float]
    """Percentage within each of `ADD_FRACTIONS` of the diagonal."""

    median_corner_error: float
    """Relative; infinite unless more than half are localized."""

    deg_cm: dict[int, float] | None
    """Percentage within n degrees and n cm for each of `DEG_CM`; None where the unit is unknown."""

    confidence_wrong: float | None
    """Share of wrong poses, off by a tenth of the diagonal or more, among those that are `SURE`; None where
    no pose is."""

    references_tried: float
    """Reference images that a query was matched with, on average."""

    seconds: Seconds
    """Mean time a query."""

    @property
    def fps(self) -> float:
        """Queries a second, all stages together."""
        return 1 / self.seconds.total


def score(errors: Sequence[PoseError], localizations: Sequence[Localization], *, metric: bool) -> Scores:
    """Sum up what localizing queries gave; row i of both belongs to query i.

    Raises:
        ValueError: There is no query.
    """
    if not errors:
        raise ValueError("errors must hold at least one query")
    stages = np.array([(one.seconds.extract, one.seconds.match, one.seconds.pose) for one in localizations])
    extract, match, pose = stages.mean(axis=0).tolist()
    return Scores(
        queries=len(errors),
        localized=100 * float(np.mean([one.pose is not None for one in localizations])),
        add={fraction: add_percent(errors, fraction) for fraction in ADD_FRACTIONS},
        median_corner_error=float(np.median([error.relative_corner_error for error in errors])),
        deg_cm={n: deg_cm_percent(errors, n) for n in DEG_CM} if metric else None,
        confidence_wrong=confidence_wrong(errors, localizations),
        references_tried=float(np.mean([one.references for one in localizations])),
        seconds=Seconds(extract=extract, match=match, pose=pose),
    )
