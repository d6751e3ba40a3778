"""Which pairs of images to match where there are no local features to tell which look alike."""

from collections.abc import Mapping

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.errors import InputError
from slimsfm.mapping.pairs import PairChoice, Pairs, exhaustive_pairs, sequential_pairs

_MOST_EXHAUSTIVE = 30  # images, up to which "auto" matches each with every other one: networks are slow
_NEIGHBOURS = 10
_LEAST_ANGLE_DEG = 10.0  # by which neighbours look elsewhere: else there is nothing to triangulate


def choose_image_pairs(
    names: list[str], choice: PairChoice, cam_from_world: Mapping[str, pycolmap.Rigid3d] | None
) -> Pairs:
    """Choose the pairs of images to match.

    Auto: each with every other one up to 30 images; above that neighbours by pose where poses are known, else
    by order of name.

    Raises:
        InputError: Images that look alike are asked for.
    """
    if choice == "similar":
        raise InputError(
            "pairs of similar images are found by local features, which there are none of; "
            "use `pairs='exhaustive'` or `pairs='sequential'`"
        )
    if choice == "exhaustive" or (choice == "auto" and len(names) <= _MOST_EXHAUSTIVE):
        return exhaustive_pairs(names)
    if choice == "sequential" or cam_from_world is None:
        return sequential_pairs(names)
    return neighbouring_pairs({name: cam_from_world[name] for name in names})


def neighbouring_pairs(cam_from_world: Mapping[str, pycolmap.Rigid3d]) -> Pairs:
    """Each image with those taken from nearby that look at least 10 degrees elsewhere.

    Of the 20 nearest every second, as OnePose++ [1] chooses them, so that some are farther apart.

    References:
        [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation
            without CAD Models, NeurIPS 2022.
    """
    names = sorted(cam_from_world)
    distances = _distances([cam_from_world[name] for name in names])
    found = set()
    for row, name in enumerate(names):
        nearest = np.argsort(distances[row], kind="stable")[: np.isfinite(distances[row]).sum()]
        step = 2 if len(nearest) >= 2 * _NEIGHBOURS else 1
        chosen = nearest[::step][:_NEIGHBOURS]
        found |= {(min(name, names[other]), max(name, names[other])) for other in chosen.tolist()}
    return sorted(found)


def _distances(cam_from_world: list[pycolmap.Rigid3d]) -> Float64[np.ndarray, "n n"]:
    """Distances between cameras; infinite where they look less than the least angle apart."""
    centers = np.array([pose.inverse().translation for pose in cam_from_world])
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    rotations = np.array([pose.rotation.matrix() for pose in cam_from_world])
    cosines = (np.einsum("aij,bij->ab", rotations, rotations) - 1) / 2
    distances[cosines > np.cos(np.radians(_LEAST_ANGLE_DEG))] = np.inf
    return distances
