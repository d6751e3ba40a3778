"""The tracks of a model as arrays, and the choice of each track's reference observation."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from slimsfm.arrays import Ids, Mask, Points3D

_Rows = Int64[np.ndarray, " k"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks:
    """All observations of a model's points, at most one per image and point; sorted by point, then image."""

    names: tuple[str, ...]
    """Names of the registered images, sorted."""

    point3D_ids: Ids
    """Ids of the points, ascending."""

    points3D_in_world: Points3D
    """Positions of the points."""

    points: _Rows
    """Point of each observation, a row of `point3D_ids`."""

    images: _Rows
    """Image of each observation, a row of `names`."""

    keypoints: _Rows
    """Keypoint of each observation, a row of the image's keypoints."""

    points2D: Float64[np.ndarray, "k 2"]
    """Pixels of each observation."""


def read_tracks(model: pycolmap.Reconstruction) -> Tracks:
    """Read the tracks of a model; if an image observes a point twice, the first keypoint counts."""
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    point3D_ids = np.array(sorted(model.point3D_ids()), np.int64)
    parts = [_observations(image, row, point3D_ids) for row, image in enumerate(images)]
    columns = np.concatenate([np.zeros((0, 3), np.int64), *(rows for rows, _ in parts)])
    points2D = np.concatenate([np.zeros((0, 2)), *(pixels for _, pixels in parts)])
    order = np.lexsort(columns.T[::-1])
    _, first = np.unique(columns[order, :2], axis=0, return_index=True)
    points, seen_by, keypoints = columns[order[first]].T
    return Tracks(
        names=tuple(image.name for image in images),
        point3D_ids=point3D_ids,
        points3D_in_world=np.array([model.point3D(i).xyz for i in point3D_ids]).reshape(-1, 3),
        points=points,
        images=seen_by,
        keypoints=keypoints,
        points2D=points2D[order[first]],
    )


def _observations(
    image: pycolmap.Image, row: int, point3D_ids: Ids
) -> tuple[Int64[np.ndarray, "k 3"], Float64[np.ndarray, "k 2"]]:
    """Rows (point, image, keypoint) and pixels of the observations of an image."""
    keypoints, points2D = np.array(image.get_observation_point2D_idxs(), np.int64), image.points2D
    seen = [points2D[keypoint] for keypoint in keypoints.tolist()]
    points = np.searchsorted(point3D_ids, np.array([point.point3D_id for point in seen], np.int64))
    pixels = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
    return np.stack([points, np.full(len(points), row), keypoints], axis=1), pixels


def choose_references(tracks: Tracks) -> Mask:
    """Choose the reference observation of each point, greedily from as few images as possible.

    The image that observes most points without a reference becomes the reference of all of them, as in
    OnePose++ [1]; this repeats until every point has one. Ties go to the first name.
    O(images * observations).

    References:
        [1] He, Sun, Wang, Huang, Bao and Zhou, OnePose++: Keypoint-Free One-Shot Object Pose Estimation
            without CAD Models, NeurIPS 2022.
    """
    is_reference = np.zeros(len(tracks.points), dtype=bool)
    is_open = np.ones(len(tracks.points), dtype=bool)
    while is_open.any():
        counts = np.bincount(tracks.images[is_open], minlength=len(tracks.names))
        chosen = is_open & (tracks.images == counts.argmax())
        is_reference |= chosen
        settled = np.zeros(len(tracks.point3D_ids), dtype=bool)
        settled[tracks.points[chosen]] = True
        is_open &= ~settled[tracks.points]
    return is_reference
