"""The similarity between the frames of two maps, from images whose pose is known in both.

A pair of poses of one image tells more than two positions: each fixes the rotation alone. So images on a line
suffice, and two that stand apart fix the scale.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64
from scipy.stats import t as student

from slimsfm.arrays import Mask, Points3D, evenly_spaced
from slimsfm.errors import InputError
from slimsfm.localization import Localizer
from slimsfm.mapping.map import Map
from slimsfm.progress import ProgressBar, silent
from slimsfm.upkeep.similarity import MAX_SCALE_ERROR, percent, sampled, turn_information

_LEAST_IMAGES = 3
_MOST_IMAGES = 60  # that are localized
_LEAST_TURN_DEG, _LEAST_SHIFT = 0.1, 1e-3  # accuracy of poses; the shift is over the extent of the cameras
_INLIER = 4.0  # robust standard deviations
_ROUNDS = 20
_TINY = 1e-300
_LEAST_SHARE = 0.5  # of the images, that must agree
_LARGEST_TURN_DEG = 5.0  # between the poses of an image: more is no inaccuracy


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePairs:
    """Images whose pose is known in two maps."""

    names: tuple[str, ...]
    """Names of the images."""

    cam_from_target: tuple[pycolmap.Rigid3d, ...]
    """Their poses in the one map."""

    cam_from_source: tuple[pycolmap.Rigid3d, ...]
    """Their poses in the other map."""

    how: str
    """Where the pairs come from: "shared images" or "localized images"."""

    tried: int
    """Number of images that were looked at."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MapSimilarity:
    """How one map lies in the frame of another one."""

    target_from_source: pycolmap.Sim3d
    """The similarity."""

    pairs: PosePairs
    """The images that it was computed from."""

    is_inlier: Mask
    """Which of these agree with it."""

    residuals: Float64[np.ndarray, " n"]
    """Distance between the two positions of each image, in units of the target."""

    turns_deg: Float64[np.ndarray, " n"]
    """Angle between the two rotations of each image."""

    turn_bound_deg: float
    """Error of the rotation that 95 % stay below."""

    scale_bound: float
    """Relative error of the scale that 95 % stay below."""


def similarity_between(target: Map, source: Map, *, progress: ProgressBar = silent) -> MapSimilarity:
    """Find how one map lies in another one: by images that both have, else by localizing images.

    Images of equal names may be different ones. So where they contradict each other, images are localized.

    Raises:
        InputError: The maps cannot be compared, or are not of one place.
    """
    shared = shared_poses(target, source)
    if len(shared.names) >= _LEAST_IMAGES:
        try:
            return similarity_from_poses(shared)
        except InputError as error:
            with suppress(InputError):
                return similarity_from_poses(localized_poses(target, source, progress=progress))
            raise error
    return similarity_from_poses(localized_poses(target, source, progress=progress))


def shared_poses(target: Map, source: Map) -> PosePairs:
    """The images that both maps have, by name."""
    names = tuple(name for name in source.images if name in target.images)
    return PosePairs(
        names=names,
        cam_from_target=tuple(target.images[name].cam_from_world() for name in names),
        cam_from_source=tuple(source.images[name].cam_from_world() for name in names),
        how="shared images",
        tried=len(names),
    )


def localized_poses(target: Map, source: Map, *, progress: ProgressBar = silent) -> PosePairs:
    """Localize images of one map, by its features, in the other one; in whichever direction is possible.

    Raises:
        InputError: The maps have different extractors, or neither has features of its images.
    """
    if target.info.extractor != source.info.extractor:
        raise InputError(
            f"the maps have the extractors {source.info.extractor} and {target.info.extractor} and share no "
            "images, so nothing can be compared; build one of them with the extractor of the other"
        )
    if not source.has_keypoints:
        raise InputError(
            f"the maps share no images, and images cannot be compared by {source.info.extractor}, which "
            "finds no keypoints; build both with an extractor that does"
        )
    if source.features:
        return _localized(target, source, progress)
    if not target.features:
        raise InputError(
            "the maps share no images, and neither holds features of its images; use the full map that one "
            "of them was reduced from"
        )
    other = localized_poses(source, target, progress=progress)
    return PosePairs(
        names=other.names,
        cam_from_target=other.cam_from_source,
        cam_from_source=other.cam_from_target,
        how=other.how,
        tried=other.tried,
    )


def _localized(target: Map, source: Map, progress: ProgressBar) -> PosePairs:
    names, localizer = list(source.images), Localizer(target)
    chosen = [names[row] for row in evenly_spaced(len(names), _MOST_IMAGES)]
    found = {}
    for name in progress(chosen, "localize images of the one map in the other"):
        pose = localizer.localize_features(source.features[name], source.camera(name)).pose
        if pose is not None:
            found[name] = pose.cam_from_world
    return PosePairs(
        names=tuple(found),
        cam_from_target=tuple(found.values()),
        cam_from_source=tuple(source.images[name].cam_from_world() for name in found),
        how="localized images",
        tried=len(chosen),
    )


def similarity_from_poses(pairs: PosePairs, *, seed: int = 0) -> MapSimilarity:
    """Find the similarity that most pairs of poses agree with, and check that it is determined.

    The rotation that most images agree with comes first, then scale and shift, then least squares of both.

    Raises:
        InputError: There are fewer than three images, they contradict each other, or their positions are too
            close to tell the scale.
    """
    if len(pairs.names) < _LEAST_IMAGES:
        raise InputError(
            f"too few images link the maps ({pairs.how}: {len(pairs.names)} of {pairs.tried}, and it takes "
            f"at least {_LEAST_IMAGES}); use maps that show the same place"
        )
    turns = np.array(
        [
            (one.rotation.inverse() * other.rotation).matrix()
            for one, other in zip(pairs.cam_from_target, pairs.cam_from_source, strict=True)
        ]
    )
    target, source = _centers(pairs.cam_from_target), _centers(pairs.cam_from_source)
    start = _start(turns, source, target, seed)
    return _checked(_adjusted(start, turns, source, target, pairs), pairs)


def _centers(poses: tuple[pycolmap.Rigid3d, ...]) -> Points3D:
    return np.array([pose.inverse().translation for pose in poses])


def _angles(
    turns: Float64[np.ndarray, "n 3 3"], turn: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Rotation vectors, in degrees, from one rotation to others."""
    return np.degrees([_vector(one @ turn.T) for one in turns])


def _vector(matrix: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3"]:
    x, y, z, w = pycolmap.Rotation3d(matrix).quat
    sine = np.linalg.norm([x, y, z])
    angle = 2 * np.arctan2(sine, abs(w))
    return np.array([x, y, z]) * np.sign(w or 1.0) * (angle / sine if sine > 0 else 2.0)


def _start(
    turns: Float64[np.ndarray, "n 3 3"], source: Points3D, target: Points3D, seed: int
) -> pycolmap.Sim3d:
    """The rotation of the image that most others are close to, then the best scale of two images."""
    medians = [np.median(np.linalg.norm(_angles(turns, one), axis=1)) for one in turns]
    turn = turns[int(np.argmin(medians))]
    turned, best, found = source @ turn.T, np.inf, None
    for i, j in sampled(len(source), 2, seed):
        ours, theirs = turned[j] - turned[i], target[j] - target[i]
        if not ours @ theirs > 0:
            continue
        scale = np.linalg.norm(theirs) / np.linalg.norm(ours)
        shift = target[i] - scale * turned[i]
        median = np.median(np.linalg.norm(scale * turned + shift - target, axis=1))
        if median < best:
            best, found = median, pycolmap.Sim3d(float(scale), pycolmap.Rotation3d(turn), shift)
    if found is None:
        raise InputError(
            "the images that both maps have contradict each other, or stand in one place; use maps of one "
            "place"
        )
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class _Weights:
    """Which images agree, and how exact their poses are."""

    kept: Mask
    sigma: float
    sigma_turn: float


def _weights(
    found: pycolmap.Sim3d, turns: Float64[np.ndarray, "n 3 3"], source: Points3D, target: Points3D
) -> _Weights:
    least = _LEAST_SHIFT * float(np.linalg.norm(target.std(axis=0)))
    apart = np.linalg.norm(target - found * source, axis=1)
    turned = np.radians(np.linalg.norm(_angles(turns, found.rotation.matrix()), axis=1))
    spread = max(1.4826 * float(np.median(apart)), least)
    spread_turn = max(1.4826 * float(np.median(turned)), np.radians(_LEAST_TURN_DEG))
    kept = (apart <= _INLIER * spread) & (turned <= _INLIER * spread_turn)
    return _Weights(kept=kept, sigma=spread / np.sqrt(3), sigma_turn=spread_turn / np.sqrt(3))


def _turn_information(weights: _Weights, moved: Points3D) -> Float64[np.ndarray, "3 3"]:
    """What the positions and the rotations of images say about the rotation of the map."""
    by_positions = turn_information(moved - moved.mean(axis=0), weights.sigma)
    return by_positions + len(moved) / weights.sigma_turn**2 * np.eye(3)


def _step(
    found: pycolmap.Sim3d,
    weights: _Weights,
    turns: Float64[np.ndarray, "n 3 3"],
    source: Points3D,
    target: Points3D,
) -> pycolmap.Sim3d:
    """One step of Gauss and Newton; rotation, scale and shift do not depend on each other."""
    kept = weights.kept
    moved, aim = found * source[kept], target[kept]
    offsets, shifts = moved - moved.mean(axis=0), aim - aim.mean(axis=0)
    angles = np.radians(_angles(turns[kept], found.rotation.matrix()))
    pull = np.cross(offsets, shifts).sum(axis=0) / weights.sigma**2
    pull += angles.sum(axis=0) / weights.sigma_turn**2
    rotation = pycolmap.Rotation3d(np.linalg.solve(_turn_information(weights, moved), pull)) * found.rotation
    grown = float(np.sum(offsets * shifts) / max(np.sum(offsets**2), _TINY)) - 1
    scale = found.scale * np.exp(np.clip(grown, -0.5, 0.5))
    shift = aim.mean(axis=0) - scale * (rotation * source[kept].mean(axis=0))
    return pycolmap.Sim3d(float(scale), rotation, shift)


def _adjusted(
    found: pycolmap.Sim3d,
    turns: Float64[np.ndarray, "n 3 3"],
    source: Points3D,
    target: Points3D,
    pairs: PosePairs,
) -> MapSimilarity:
    """Least squares over the images that agree."""
    weights = _weights(found, turns, source, target)
    for _ in range(_ROUNDS):
        if not weights.kept.any():
            break
        found = _step(found, weights, turns, source, target)
        weights = _weights(found, turns, source, target)
    kept = weights.kept
    moved = (found * source)[kept] if kept.any() else target
    quantile = float(student.ppf(0.975, max(6 * int(kept.sum()) - 7, 1)))
    least = float(np.linalg.eigvalsh(_turn_information(weights, moved))[0])
    extent = np.linalg.norm(moved - moved.mean(axis=0))
    return MapSimilarity(
        target_from_source=found,
        pairs=pairs,
        is_inlier=kept,
        residuals=np.linalg.norm(target - found * source, axis=1),
        turns_deg=np.linalg.norm(_angles(turns, found.rotation.matrix()), axis=1),
        turn_bound_deg=float(np.degrees(quantile / np.sqrt(least))),
        scale_bound=float(quantile * weights.sigma / max(extent, _TINY)),
    )


def _checked(found: MapSimilarity, pairs: PosePairs) -> MapSimilarity:
    number, total = int(found.is_inlier.sum()), len(pairs.names)
    typical = float(np.median(found.turns_deg))
    if number < _LEAST_IMAGES or number < _LEAST_SHARE * total or typical > _LARGEST_TURN_DEG:
        raise InputError(
            f"the {total} {pairs.how} contradict each other: {number} agree, and their rotations in the two "
            f"maps differ by {typical:.2g}° (median); the maps are not of one place, or one of them is wrong"
        )
    if found.scale_bound > MAX_SCALE_ERROR:
        raise InputError(
            f"the {number} {pairs.how} that agree do not determine the scale, which may be "
            f"{percent(found.scale_bound)} off: they stand too close to each other; use maps that share more"
        )
    return found
