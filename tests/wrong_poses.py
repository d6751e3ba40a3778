"""An exact map whose images are all matched, and the same map with wrong poses."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
import pycolmap

from scenes import exact_map
from slimsfm.mapping.map import Map


def matched_map(num_images: int = 12, num_points: int = 160) -> Map:
    """A map whose pairs of images are matched as its tracks say."""
    map_ = exact_map(num_images, num_points, reach_deg=80)
    matches = {}
    for a, b in combinations(map_.images, 2):
        _, rows_a, rows_b = np.intersect1d(
            map_.observations[a].points, map_.observations[b].points, return_indices=True
        )
        if len(rows_a):
            rows = map_.observations[a].rows[rows_a], map_.observations[b].rows[rows_b]
            matches[a, b] = np.stack(rows, axis=1)
    return replace(map_, matches=matches)


def with_poses(map_: Map, poses: Mapping[str, pycolmap.Rigid3d]) -> Map:
    """The map with other poses of some images; tracks and points stay."""
    model = pycolmap.Reconstruction(map_.model)
    for name, pose in poses.items():
        model.frame(map_.images[name].frame_id).rig_from_world = pose
    return replace(map_, model=model)


def swapped(map_: Map, a: str, b: str) -> Map:
    """The map in which two images have each other's poses."""
    poses = {name: map_.images[name].cam_from_world() for name in (a, b)}
    return with_poses(map_, {a: poses[b], b: poses[a]})


def turned(map_: Map, name: str, angle_deg: float) -> Map:
    """The map in which an image was moved around the middle of the scene."""
    turn = pycolmap.Rotation3d(np.array([0.0, 0.0, np.radians(angle_deg)]))
    return with_poses(map_, {name: map_.images[name].cam_from_world() * pycolmap.Rigid3d(turn, np.zeros(3))})
