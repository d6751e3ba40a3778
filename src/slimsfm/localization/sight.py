"""Which poses a map allows: poses that contradict themselves, or that the map cannot see, are no results."""

from collections.abc import Iterator

import numpy as np
import pycolmap

from slimsfm.arrays import Ids, Points3D
from slimsfm.geometry import project
from slimsfm.lenses import camera_fault
from slimsfm.mapping.map import Map
from slimsfm.pose import PoseEstimate

_FACTOR = 30.0  # in scale, from the references to a query: local features match up to about 10


class Sight:
    """How large the references of a map show its points, in the pixels in which features were found."""

    def __init__(self, map: Map) -> None:
        scales = list(_scales(map))
        self._smallest = min(scales, default=0.0) / _FACTOR
        self._largest = max(scales, default=float("inf")) * _FACTOR

    def allows(self, pose: PoseEstimate, points3D_in_world: Points3D, camera: pycolmap.Camera) -> bool:
        """Whether a pose may be right.

        Its numbers are finite, its inliers in front of the camera, estimated intrinsics are possible, and the
        image shows the inliers at most 30 times as large or small as a reference shows its points. Beyond
        that, where a camera has left the object far behind, no features match.

        Args:
            pose: The pose.
            points3D_in_world: The points of the matches that it was estimated from.
            camera: The intrinsics that it was estimated with or that were estimated with it.
        """
        in_cam = pose.cam_from_world * points3D_in_world[pose.inliers]
        if not pose.is_finite or in_cam[:, 2].min() <= 0 or (pose.camera and camera_fault(pose.camera)):
            return False
        return self._smallest <= _scale(in_cam, camera) <= self._largest


def _scales(map: Map) -> Iterator[float]:
    for name, image in map.images.items():
        seen = _seen(map, name)
        if len(seen):
            points, camera = map.points3D_in_world[seen], map.camera(name)
            yield _scale(image.cam_from_world() * points, camera) / map.shrink_factor(name)


def _seen(map: Map, name: str) -> Ids:
    """Points that a reference observes; without observations, those that project into it."""
    if len(map.observations[name].points):
        return map.observations[name].points
    camera = map.camera(name)
    pixels = project(map.points3D_in_world, map.images[name].cam_from_world(), camera)
    return np.flatnonzero(np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1))


def _scale(points3D_in_cam: Points3D, camera: pycolmap.Camera) -> float:
    """Pixels per map unit at the points of median distance."""
    squares, middle = np.einsum("nd,nd->n", points3D_in_cam, points3D_in_cam), len(points3D_in_cam) // 2
    distance = np.sqrt(np.partition(squares, middle)[middle])
    return float(camera.mean_focal_length() / max(distance, np.finfo(np.float64).tiny))
