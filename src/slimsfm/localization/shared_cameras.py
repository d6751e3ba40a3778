"""The focal length of several queries that were taken with one camera, estimated together.

One photo often leaves its focal length uncertain, because a longer lens looks like a shorter distance. What a
few photos agree on is more exact, and the other photos of that camera then need only a pose.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from slimsfm.arrays import evenly_spaced
from slimsfm.localization.cameras import QueryCamera
from slimsfm.localization.outcome import Localization
from slimsfm.localization.search import TRUSTED
from slimsfm.pose.priors import with_focal_length

_SAMPLED = 8  # photos of a camera that its focal length is estimated from
_LEAST = 3  # of them that must determine it
_SURE = 0.8  # confidence of their poses
_EXACT = 0.1  # largest standard deviation of the logarithm of a focal length
_AGREE = 0.05  # largest deviation of the logarithms from their median, for most of them

Localize = Callable[[Sequence[str]], Sequence[Localization]]
"""Localizes the images of these names."""


def share_cameras(cameras: Mapping[str, QueryCamera], localize: Localize) -> dict[str, QueryCamera]:
    """Estimate focal lengths that are not known for all queries of one camera together.

    Queries of one size whose intrinsics come from the same EXIF data, or from nowhere, are taken for photos
    of one camera. A few of them are localized. If these agree on the focal length, all photos get it.

    Args:
        cameras: The intrinsics of each query by its name.
        localize: How to localize queries.

    Returns:
        The intrinsics of each query; where they are shared, their source is "queries".
    """
    shared = dict(cameras)
    for names in _groups(cameras):
        if cameras[names[0]].source in ("exif", "unknown"):
            sampled = [names[place] for place in evenly_spaced(len(names), _SAMPLED)]
            focal_px = _agreed_focal_length(localize(sampled))
            shared.update(_with_focal_length(cameras, names, focal_px))
    return shared


def corrected_cameras(
    cameras: Mapping[str, QueryCamera], found: Mapping[str, Localization]
) -> dict[str, QueryCamera]:
    """The queries whose camera was believed although most others of that camera contradicted it.

    Args:
        cameras: The intrinsics that each query was localized with, by its name.
        found: The outcome of each query.

    Returns:
        The intrinsics that the others agree on, for each query that should be localized again.
    """
    again: dict[str, QueryCamera] = {}
    for names in _groups(cameras):
        corrected = [name for name in names if found[name].camera_estimated]
        localized = [name for name in names if found[name].pose]
        left = [name for name in names if not found[name].camera_estimated]
        if cameras[names[0]].source in TRUSTED and left and 2 * len(corrected) > len(localized):
            focal_px = _agreed_focal_length([found[name] for name in corrected])
            again.update(_with_focal_length(cameras, left, focal_px))
    return again


def _groups(cameras: Mapping[str, QueryCamera]) -> list[list[str]]:
    """Names of the queries that seem to be of one camera, if they are enough."""
    groups: dict[tuple, list[str]] = defaultdict(list)
    for name, one in cameras.items():
        size = one.camera.width, one.camera.height
        groups[one.source, size, tuple(one.camera.params)].append(name)
    return [names for names in groups.values() if len(names) >= _LEAST]


def _with_focal_length(
    cameras: Mapping[str, QueryCamera], names: Sequence[str], focal_px: float | None
) -> dict[str, QueryCamera]:
    if focal_px is None:
        return {}
    camera = with_focal_length(cameras[names[0]].camera, focal_px)
    return {name: QueryCamera(camera=camera, source="queries", notes=cameras[name].notes) for name in names}


def _agreed_focal_length(found: Sequence[Localization]) -> float | None:
    """The mean of the estimated focal lengths, weighted by their certainty; None if they differ."""
    poses = [
        one.pose
        for one in found
        if one.pose
        and one.pose.camera
        and (one.pose.confidence or 0) >= _SURE
        and one.pose.relative_focal_sigma is not None
        and one.pose.relative_focal_sigma < _EXACT
    ]
    if len(poses) < _LEAST:
        return None
    logs = np.log([one.camera.mean_focal_length() for one in poses if one.camera])
    sigmas = np.array([one.relative_focal_sigma for one in poses])
    near = np.abs(logs - np.median(logs)) < _AGREE
    if near.sum() < max(_LEAST, 2 / 3 * len(logs)):
        return None
    return float(np.exp(np.average(logs[near], weights=sigmas[near] ** -2)))
