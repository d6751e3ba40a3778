"""An exact map whose images are all matched, and the same map with wrong poses."""

from collections.abc import Collection, Mapping
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


def laid_over(map_: Map, names: Collection[str], angle_deg: float) -> Map:
    """The map folded: some images, and all that they alone see, were moved around the middle of the scene."""
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.0, np.radians(angle_deg)])), np.zeros(3))
    folded = with_poses(map_, {name: map_.images[name].cam_from_world() * turn for name in names})
    part, model = {map_.images[name].image_id for name in names}, folded.model
    for point_id in sorted(model.point3D_ids()):
        point = model.point3D(point_id)
        seen = [(one.image_id, one.point2D_idx) for one in point.track.elements]
        places, color = (point.xyz.copy(), turn.inverse() * point.xyz), point.color.copy()
        model.delete_point3D(point_id)
        for is_part, place in enumerate(places):
            track = pycolmap.Track()
            for image_id, row in seen:
                if (image_id in part) == is_part:
                    track.add_element(image_id, row)
            if track.length() >= 2:
                model.add_point3D(place, track, color)
    return replace(map_, model=model)
