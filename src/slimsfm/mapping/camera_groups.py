"""Photos that were given one camera although they have several focal lengths, because some were zoomed."""

from collections import defaultdict
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import pycolmap

from slimsfm.mapping.model import positions
from slimsfm.mapping.sfm import adjust

_ITERATIONS = 10  # of bundle adjustment; enough to see where focal lengths go
_OFF = 0.15  # of the logarithm of a focal length from the median: another focal length
_LEAST, _LEAST_SHARE = 2, 0.05  # photos of a camera that must be off
_GAP = 0.1  # between the logarithms of the focal lengths of two groups


def has_several_focal_lengths(model: pycolmap.Reconstruction) -> bool:
    """Whether photos that share a camera drift to different focal lengths when each has its own.

    The model does not change. The bundle adjustment of a right model leaves all but a few photos within 10 %.
    """
    shared = _images_by_camera(model)
    if max(map(len, shared.values()), default=0) <= _LEAST or not model.num_points3D():
        return False
    apart = with_own_cameras(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    adjust(apart, options)
    for image_ids in shared.values():
        logs = np.log([max(apart.camera(i).mean_focal_length(), 1e-9) for i in image_ids])
        off = int((np.abs(logs - np.median(logs)) > _OFF).sum())
        if off >= max(_LEAST, _LEAST_SHARE * len(image_ids)):
            return True
    return False


def _images_by_camera(model: pycolmap.Reconstruction) -> dict[int, list[int]]:
    found: dict[int, list[int]] = defaultdict(list)
    for image_id in sorted(model.reg_image_ids()):
        found[model.image(image_id).camera_id].append(image_id)
    return found


def with_own_cameras(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model, and give each image a camera of its own, with the id of the image."""
    copy = pycolmap.Reconstruction()
    images = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    for image in images:
        copy.add_camera_with_trivial_rig(own_camera(model.camera(image.camera_id), image.image_id))
    for image in images:
        moved = pycolmap.Image(
            name=image.name, keypoints=positions(image), camera_id=image.image_id, image_id=image.image_id
        )
        copy.add_image_with_trivial_frame(moved, image.cam_from_world())
    for point3D_id, point in model.points3D.items():
        copy.add_point3D_with_id(point3D_id, point)
    return copy


def own_camera(camera: pycolmap.Camera, camera_id: int) -> pycolmap.Camera:
    """Copy a camera under another id."""
    copy = pycolmap.Camera(
        model=camera.model_name,
        width=camera.width,
        height=camera.height,
        params=camera.params,
        camera_id=camera_id,
    )
    copy.has_prior_focal_length = camera.has_prior_focal_length
    return copy


def split_cameras(
    model: pycolmap.Reconstruction, cameras: Mapping[int, pycolmap.Camera]
) -> dict[int, pycolmap.Camera]:
    """Split the cameras that photos share into groups of equal focal length.

    Args:
        model: A model in which each image has a camera of its own.
        cameras: The shared cameras, by the id of each image.

    Returns:
        A camera for each image, with the id of the first image of its group. Images that are not in the model
        are with the largest group of their camera. A camera none of whose images is in the model stays whole.
    """
    of_camera: dict[int, list[int]] = defaultdict(list)
    for image_id in sorted(model.reg_image_ids()):
        of_camera[cameras[image_id].camera_id].append(image_id)
    split: dict[int, pycolmap.Camera] = {}
    for camera_id, image_ids in of_camera.items():
        groups = _groups({i: np.log(model.camera(i).mean_focal_length()) for i in image_ids})
        for group in groups:
            median = float(np.median([model.camera(i).mean_focal_length() for i in group]))
            camera = own_camera(cameras[group[0]], min(group))
            camera.params = _with_focal_length(camera, median)
            split.update(dict.fromkeys(group, camera))
        largest = split[max(groups, key=len)[0]]
        for image_id, camera in cameras.items():
            if camera.camera_id == camera_id:
                split.setdefault(image_id, largest)
    first = {camera.camera_id: image_id for image_id, camera in sorted(cameras.items(), reverse=True)}
    for image_id, camera in cameras.items():
        split.setdefault(image_id, own_camera(camera, first[camera.camera_id]))
    return split


def _groups(logs: Mapping[int, float]) -> list[list[int]]:
    ordered = sorted(logs, key=lambda image_id: (logs[image_id], image_id))
    groups = [[ordered[0]]]
    for before, image_id in pairwise(ordered):
        if logs[image_id] - logs[before] > _GAP:
            groups.append([])
        groups[-1].append(image_id)
    return groups


def _with_focal_length(camera: pycolmap.Camera, focal_length: float) -> list[float]:
    params = np.array(camera.params)
    params[camera.focal_length_idxs()] = focal_length
    return params.tolist()
