"""Answers as JSON: maps, their points, and the outcome of localization. Keys are those of `poses.json`."""

from typing import Any

import numpy as np
import pycolmap

from slimsfm.localization import Localization
from slimsfm.mapping.map import Map
from slimsfm.serve.geopose import geopose_of
from slimsfm.serve.maps import ServedMap

Json = dict[str, Any]

MAX_POINTS = 5000
"""Largest number of points in an answer."""


def map_reply(served: ServedMap) -> Json:
    """What a client may know of a map."""
    map_ = served.localizer.map
    camera = map_.shared_camera
    return {
        "id": served.id,
        "version": served.version,
        "unit": map_.info.unit,
        "box": {"corners": map_.box.corners.tolist(), "diagonal": float(map_.box.diagonal)},
        "attribution": map_.info.origin,
        "kind": map_.kind,
        "num_points": len(map_.point3D_ids),
        "num_images": len(map_.images),
        "orientation": map_.info.orientation,
        "camera": None if camera is None else camera_reply(camera),
        "georeferenced": map_.info.georeference is not None,
        "model": served.model is not None,
    }


def points_reply(served: ServedMap) -> Json:
    """Positions and colors of the points, at most `MAX_POINTS`, the same ones each time."""
    map_ = served.localizer.map
    rows = spread_rows(len(map_.points3D_in_world), MAX_POINTS)
    return {
        "map_version": served.version,
        "count": len(rows),
        "positions": np.round(map_.points3D_in_world[rows], _digits(map_)).tolist(),
        "colors": map_.colors[rows].tolist(),
    }


def spread_rows(count: int, most: int) -> np.ndarray:
    """At most `most` of `count` rows, in equal steps."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _digits(map: Map) -> int:
    """Decimals that resolve a hundred-thousandth of the object."""
    return max(0, 5 - int(np.floor(np.log10(map.box.diagonal))))


def camera_reply(camera: pycolmap.Camera) -> Json:
    """Intrinsics, with those of a pinhole by name."""
    return {
        "model": camera.model_name,
        "width": camera.width,
        "height": camera.height,
        "fx": camera.focal_length_x,
        "fy": camera.focal_length_y,
        "cx": camera.principal_point_x,
        "cy": camera.principal_point_y,
        "params": camera.params.tolist(),
    }


def pose_reply(cam_from_world: pycolmap.Rigid3d) -> Json:
    """A pose as in `poses.json`."""
    return {
        "quaternion_xyzw": cam_from_world.rotation.quat.tolist(),
        "translation": cam_from_world.translation.tolist(),
    }


def localization_reply(served: ServedMap, found: Localization) -> Json:
    """The outcome of an image or a frame; `ms` is the caller's."""
    map_, pose, relative = served.localizer.map, found.pose, found.predicted_corner_error
    return {
        "found": pose is not None,
        "reason": found.reason,
        "map": served.id,
        "map_version": served.version,
        "unit": map_.info.unit,
        "cam_from_world": pose and pose_reply(pose.cam_from_world),
        "confidence": pose and pose.confidence,
        "inliers": pose.num_inliers if pose else 0,
        "predicted_error": None if relative is None else relative * float(map_.box.diagonal),
        "predicted_corner_error": relative,
        "position_bound_95": pose and pose.position_bound,
        "rotation_bound_95_deg": pose and pose.rotation_bound_deg,
        "camera": camera_reply(found.camera),
        "camera_source": found.camera_source,
        "camera_estimated": list(found.camera_estimated),
        "orientation": found.orientation,
        "geopose": pose and geopose_of(map_, pose.cam_from_world),
    }
