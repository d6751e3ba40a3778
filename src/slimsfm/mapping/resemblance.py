"""Whether the descriptors of a model's points resemble each other, as they must where they were matched."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from slimsfm.arrays import Descriptors, Ids
from slimsfm.errors import ModelError
from slimsfm.features import Features, unit_rows
from slimsfm.mapping.agreement import disagreement

_ALIKE = 0.75  # share of right descriptors among those that can be tested; half are by chance
_TESTABLE = 10  # descriptors


def check_descriptors(images: list[pycolmap.Image], features: Mapping[str, Features], source: Path) -> None:
    """Check that the descriptors of a point resemble each other.

    A descriptor is right if it is closer to the mean of its point's other descriptors than to that of another
    point. O(observations).

    Raises:
        ModelError: In some images fewer than three quarters are right. All such images are named.
    """
    ids = {image.name: _observed_points(image) for image in images}
    known, rows_of = np.unique(np.concatenate([*ids.values()]), return_inverse=True)
    ends = np.cumsum([len(one) for one in ids.values()])
    points = dict(zip(ids, np.split(rows_of, ends[:-1]), strict=True))
    width = next(one.descriptors.shape[1] for one in features.values() if len(one))
    sums = np.zeros((len(known), width), np.float32)
    for image in images:
        rows, firsts = np.unique(points[image.name], return_index=True)  # np.add.at would be 500 times slower
        sums[rows] += _observed_descriptors(image, features[image.name], width)[firsts]
    if not sums.any():
        raise ModelError(f"{source}: all descriptors are zero; give features with descriptors")
    wrong = {}
    for image in images:
        own = _observed_descriptors(image, features[image.name], width)
        others = unit_rows(sums[points[image.name]] - own)
        right = (own * others).sum(axis=1)
        by_chance = (own * np.roll(others, max(1, len(own) // 2), axis=0)).sum(axis=1)
        testable = own.any(axis=1) & (np.abs(others).max(axis=1, initial=0) > 0.01)
        share = float(np.mean((right > by_chance)[testable])) if testable.any() else 1.0
        if testable.sum() >= _TESTABLE and share < _ALIKE:
            wrong[image.name] = (
                f"has {100 * share:.0f} % of its descriptors like those of the same points in other images"
            )
    if wrong:
        raise disagreement(wrong, len(images), source)


def _observed_points(image: pycolmap.Image) -> Ids:
    return np.array([point.point3D_id for point in image.get_observation_points2D()], np.int64)


def _observed_descriptors(image: pycolmap.Image, features: Features, width: int) -> Descriptors:
    rows = np.array(image.get_observation_point2D_idxs(), np.int64)
    return unit_rows(features.descriptors[rows]).reshape(-1, width)
