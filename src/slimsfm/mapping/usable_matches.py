"""Which matches of a source fit a model."""

from collections.abc import Mapping

import numpy as np
import pycolmap
from jaxtyping import Int64

from slimsfm.arrays import IndexPairs
from slimsfm.errors import ModelError
from slimsfm.features import Features
from slimsfm.mapping.agreement import Masks
from slimsfm.mapping.model import camera_of
from slimsfm.mapping.pairs import Matches
from slimsfm.mapping.sources import Source
from slimsfm.mapping.support import near_epipolar_lines, trusted_pairs

_MIN_INLIERS = 15  # matches of a verified pair, as in COLMAP


def usable_matches(
    source: Source, images: list[pycolmap.Image], features: Mapping[str, Features], unusable: Masks
) -> tuple[Matches, list[str]]:
    """The matches of a source; unverified ones are filtered by the geometry of the model's poses.

    Args:
        source: The source.
        images: The images of the model.
        features: Features by image name, at the positions of the model.
        unusable: By image name, keypoints without a position.

    Returns:
        Matches by pair of names, and notes.

    Raises:
        ModelError: A match refers to a keypoint that does not exist, or no pair fits the poses.
    """
    by_name = {image.name: image for image in images if image.num_points2D()}
    found: dict[tuple[str, str], IndexPairs] = {}
    for a, b in source.matches:
        if a not in by_name or b not in by_name or (b, a) in found:
            continue
        pairs = source.matches[a, b]
        if np.any(pairs >= (len(features[a]), len(features[b]))):
            file = source.unverified or source.path
            raise ModelError(f"{file}: the matches of {a!r} and {b!r} refer to a missing keypoint")
        pairs = pairs[~(unusable[a][pairs[:, 0]] | unusable[b][pairs[:, 1]])]
        if source.unverified:
            pairs = _consistent(pairs, (by_name[a], by_name[b]), (features[a], features[b]))
        if len(pairs):
            found[a, b] = pairs
    return found, _notes(source, found)


def evidence(
    source: Source, images: list[pycolmap.Image], features: Mapping[str, Features], usable: Matches
) -> Matches:
    """The matches to check a model by.

    Unverified matches were filtered by the poses of the model, so they cannot contradict it. Those of trusted
    pairs pass two-view geometry instead.
    """
    if not source.unverified:
        return usable
    by_name = {image.name: image for image in images if image.num_points2D()}
    raw = {pair: source.matches[pair] for pair in source.matches if by_name.keys() >= set(pair)}
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    checked = dict(usable)
    for a, b in sorted(trusted_pairs(raw, by_name)):
        points = [features[name].keypoints.astype(np.float64) for name in (a, b)]
        cameras = [camera_of(by_name[name]) for name in (a, b)]
        geometry = pycolmap.estimate_two_view_geometry(
            cameras[0], points[0], cameras[1], points[1], raw[a, b].astype(np.uint32), options
        )
        inliers = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
        if len(inliers) >= _MIN_INLIERS:
            checked[a, b] = inliers
    return checked


def _notes(source: Source, found: Matches) -> list[str]:
    lost, total = len(source.matches) - len(found), len(source.matches)
    if not source.unverified or not lost:
        return []
    if not found:
        raise ModelError(
            f"{source.unverified}: none of its {lost} pairs fits the poses of the model; give the matches of "
            "these features"
        )
    return [
        f"{source.unverified.name}: {lost} of {total} pairs were left out, with fewer than {_MIN_INLIERS} "
        "matches that fit the poses of the model"
    ]


def _consistent(
    pairs: IndexPairs, images: tuple[pycolmap.Image, pycolmap.Image], features: tuple[Features, Features]
) -> Int64[np.ndarray, "kept 2"]:
    """Matches near the epipolar lines of the model's poses; none if they are few."""
    cameras = [camera_of(image) for image in images]
    rays = [
        np.asarray(camera.cam_from_img(one.keypoints[rows].astype(np.float64)))
        for camera, one, rows in zip(cameras, features, pairs.T, strict=True)
    ]
    good = pairs[near_epipolar_lines(*images, *rays)]
    return good if len(good) >= _MIN_INLIERS else good[:0]
