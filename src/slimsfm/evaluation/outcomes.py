"""What became of queries, one by one: what every table, test and figure is computed from."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.datasets.base import ObjectModel
from slimsfm.evaluation.metrics import errors_of_poses
from slimsfm.geometry import Box
from slimsfm.localization import Localization

STAGES = ("extract", "match", "pose")
"""Of localizing a query, in this order."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """What became of queries; entry i of each field is of query i."""

    error: Float64[np.ndarray, " n"]
    """Relative to the object, see `metrics.PoseError`; infinite without a pose."""

    rotation_deg: Float64[np.ndarray, " n"]
    """Of the pose's rotation; infinite without a pose."""

    translation: Float64[np.ndarray, " n"]
    """Of the pose's translation, in map units; infinite without a pose."""

    confidence: Float64[np.ndarray, " n"]
    """Probability that the pose is right; NaN without a pose."""

    references: Int64[np.ndarray, " n"]
    """Reference images that the query was matched with."""

    seconds: Float64[np.ndarray, "n 3"]
    """Time of each of `STAGES`."""

    cam_from_world: tuple[pycolmap.Rigid3d | None, ...]
    """The poses."""

    def __post_init__(self) -> None:
        lengths = {name: len(values) for name, values in vars(self).items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"all fields must be of as many queries, got {lengths}")

    def __len__(self) -> int:
        return len(self.error)


def outcomes_of(
    found: Sequence[Localization],
    truth: Sequence[pycolmap.Rigid3d],
    box: Box,
    model: ObjectModel | None = None,
) -> Outcomes:
    """Compare what was found with the truth.

    Args:
        found: What became of each query.
        truth: Its true pose.
        box: The object's box.
        model: The object's model, where the data set has one.

    Raises:
        ValueError: There is no query, or lengths differ.
    """
    if not found:
        raise ValueError("found must hold at least one query")
    poses = tuple(one.pose and one.pose.cam_from_world for one in found)
    errors = errors_of_poses(poses, truth, box, model)
    sure = [one.pose.confidence if one.pose else None for one in found]
    return Outcomes(
        error=np.array([one.relative for one in errors]),
        rotation_deg=np.array([one.rotation_deg for one in errors]),
        translation=np.array([one.translation for one in errors]),
        confidence=np.array([np.nan if one is None else one for one in sure], np.float64),
        references=np.array([one.references for one in found], np.int64),
        seconds=np.array([[getattr(one.seconds, stage) for stage in STAGES] for one in found], np.float64),
        cam_from_world=poses,
    )


def join(parts: Sequence[Outcomes]) -> Outcomes:
    """All of them, one after the other."""
    return Outcomes(
        error=np.concatenate([one.error for one in parts]),
        rotation_deg=np.concatenate([one.rotation_deg for one in parts]),
        translation=np.concatenate([one.translation for one in parts]),
        confidence=np.concatenate([one.confidence for one in parts]),
        references=np.concatenate([one.references for one in parts]),
        seconds=np.concatenate([one.seconds for one in parts]),
        cam_from_world=tuple(pose for one in parts for pose in one.cam_from_world),
    )
