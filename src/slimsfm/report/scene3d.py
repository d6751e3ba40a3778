"""The 3D view of a map and its slim variants, as plain values that `viewer.js` draws.

The view's frame has its origin at the centre of the object's box, the box's diagonal as unit, z where the
images' upper edges point on average, and x towards the middle of the cameras.
"""

import base64
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points3D
from slimsfm.geometry import BOX_EDGES, Box
from slimsfm.mapping.map import Map

MAX_POINTS = 15_000
"""Points shown of a map."""

_FRUSTUM_LENGTH = 0.12  # over the median distance of the cameras from the box


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """A similarity from the map's frame to the view's."""

    origin_in_world: Float64[np.ndarray, "3"]
    """The centre of the box."""

    view_from_world: Float64[np.ndarray, "3 3"]
    """Rotation over the box's diagonal."""

    def apply(self, points3D_in_world: Points3D) -> Points3D:
        """Positions in the view's frame."""
        return (points3D_in_world - self.origin_in_world) @ self.view_from_world.T


def scene(maps: Mapping[str, Map], chosen: Collection[str], *, max_points: int = MAX_POINTS) -> dict:
    """What the view shows: points and images of a map's variants and the box, ready for JSON.

    Of more than `max_points` points of a map every so-manyth by id is shown.

    Args:
        maps: By name; the first is the full map, the others have some of its images.
        chosen: Images of the dominating set.
        max_points: Points shown of a map.
    """
    full = next(iter(maps.values()))
    frame = view_frame([image.cam_from_world() for image in full.images.values()], full.box)
    length = _frustum_length(full, frame)
    numbers = {name: number for number, name in enumerate(full.images)}
    return {
        "box": _rounded(frame.apply(full.box.corners)),
        "edges": BOX_EDGES,
        "images": [_frustum(full, name, frame, length) for name in full.images],
        "chosen": [int(name in chosen) for name in full.images],
        "maps": {
            name: {
                **_points(shown, frame, max_points),
                "images": [numbers[image] for image in shown.images],
            }
            for name, shown in maps.items()
        },
    }


def view_frame(cams_from_world: list[pycolmap.Rigid3d], box: Box) -> Frame:
    """Find the view's frame from where the cameras are and how they are held."""
    ups = [-pose.rotation.matrix()[1] for pose in cams_from_world]
    to_cameras = [pose.inverse().translation - box.center for pose in cams_from_world]
    z = _unit(np.mean(ups, axis=0), np.array([0.0, 0.0, 1.0]))
    middle = np.mean(to_cameras, axis=0)
    x = _unit(middle - (middle @ z) * z, _any_normal(z))
    rotation = np.stack([x, np.cross(z, x), z])
    return Frame(origin_in_world=box.center, view_from_world=rotation / box.diagonal)


def _unit(vector: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else fallback


def _any_normal(z: np.ndarray) -> np.ndarray:
    axis = np.eye(3)[np.argmin(np.abs(z))]
    normal = np.cross(z, axis)
    return normal / np.linalg.norm(normal)


def _frustum_length(map: Map, frame: Frame) -> float:
    """In the view's unit: all frustums are equally long."""
    poses = [image.cam_from_world() for image in map.images.values()]
    centers = frame.apply(np.array([pose.inverse().translation for pose in poses]))
    return _FRUSTUM_LENGTH * float(np.median(np.linalg.norm(centers, axis=1)))


def _points(map: Map, frame: Frame, max_points: int) -> dict[str, str]:
    rows = _evenly(len(map.point3D_ids), max_points)
    return {
        "points": _base64(frame.apply(map.points3D_in_world[rows]).astype("<f4")),
        "colors": _base64(map.colors[rows]),
    }


def _evenly(count: int, limit: int) -> np.ndarray:
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).astype(np.int64)


def _frustum(map: Map, name: str, frame: Frame, length: float) -> list[list[float]]:
    """The camera's centre and, at the given depth, the four corners of its image; distortion is left out."""
    image = map.images[name]
    camera = map.model.camera(image.camera_id)
    width, height = camera.width, camera.height
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], np.float64)
    rays_in_cam = pixels @ np.linalg.inv(camera.calibration_matrix()).T
    depth_in_world = length / np.linalg.norm(frame.view_from_world[0])
    corners_in_cam = np.concatenate([np.zeros((1, 3)), depth_in_world * rays_in_cam])
    return _rounded(frame.apply(image.cam_from_world().inverse() * corners_in_cam))


def _rounded(points: Points3D) -> list[list[float]]:
    return (np.round(points, 4) + 0.0).tolist()  # + 0.0: no minus before a zero


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
