"""Leave images out of a benchmark whose own poses, which serve as ground truth, are wrong."""

import logging
from collections.abc import Collection
from dataclasses import dataclass, field, replace

from slimsfm.datasets.base import TWO_VIEWS, ObjectSequences, PosedSequence
from slimsfm.errors import InputError
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.checking import wrong_poses

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class RightSequences:
    """An object without the images whose poses are wrong."""

    sequences: ObjectSequences
    """The object."""

    contradicted: dict[str, str] = field(default_factory=dict)
    """What contradicts the pose of each query or mapping image that was left out, by name."""


def with_right_poses(sequences: ObjectSequences, progress: ProgressBar = silent) -> RightSequences:
    """Leave out queries and mapping images whose poses the other images of the true model contradict.

    Only poses from Structure from Motion whose matches are known can be checked: those of photos, and of
    COLMAP models with a database. Images that the model marks as wrong are left out too.

    Raises:
        InputError: No query or fewer than two mapping images are left.
    """
    truth = sequences.truth
    if truth is None or truth.kind != "full" or not truth.matches:
        return RightSequences(sequences=sequences)
    wrong = {one.name: one.sentence for one in wrong_poses(truth, progress)}
    marked = {name: f"{name}: marked as wrong" for name in truth.info.wrong_poses if name in truth.images}
    wrong = dict(sorted({**marked, **wrong}.items()))
    if not wrong:
        return RightSequences(sequences=sequences)
    mapping, query = (_without(one, wrong) for one in (sequences.mapping, sequences.query))
    if not query.names or len(mapping.names) < TWO_VIEWS:
        raise InputError(
            f"{sequences.name}: the poses of {len(wrong)} of {len(truth.images)} images are contradicted, "
            "which leaves too few to measure with; `slimsfm check` names them"
        )
    _LOGGER.warning("%s: left out, because their own poses are wrong: %s", sequences.name, ", ".join(wrong))
    right = [name for name in truth.images if name not in wrong]
    kept = keep_images(truth, right, min_track_length=TWO_VIEWS)
    return RightSequences(
        sequences=replace(sequences, mapping=mapping, query=query, truth=kept), contradicted=wrong
    )


def with_marks(map: Map, progress: ProgressBar = silent) -> Map:
    """Mark the images of a map whose poses the others contradict, so that no set of images pays for them.

    A map without matches is not checked.
    """
    if map.kind != "full" or not map.matches:
        return map
    wrong = tuple(one.name for one in wrong_poses(map, progress))
    return replace(map, info=replace(map.info, wrong_poses=wrong)) if wrong else map


def _without(sequence: PosedSequence, wrong: Collection[str]) -> PosedSequence:
    rows = [row for row, name in enumerate(sequence.names) if name not in wrong]
    return replace(
        sequence,
        names=tuple(sequence.names[row] for row in rows),
        cameras=tuple(sequence.cameras[row] for row in rows),
        cam_from_world=tuple(sequence.cam_from_world[row] for row in rows),
    )
