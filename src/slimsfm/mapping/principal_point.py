"""Principal points, adjusted where the photos determine them.

Incremental mapping keeps the principal point of a camera in the middle of the image, because few photos do
not determine it. The lens of a phone is off by up to 3 % of the side, and focal length, poses and points make
up for it. Many photos that show the same things from different sides do determine it.
"""

from collections import Counter
from collections.abc import Set

import numpy as np
import pycolmap

from slimsfm.arrays import evenly_spaced
from slimsfm.lenses import camera_fault
from slimsfm.mapping.sfm import adjust
from slimsfm.progress import ProgressBar, silent, single_step

_MAX_STD = 2e-3  # of a principal point that counts as determined, over the longer side of the image
_FEWEST = 10  # images of a camera
_MOST_JUDGED = 200  # images by which it is decided


def with_principal_points(
    model: pycolmap.Reconstruction, cameras: Set[int], progress: ProgressBar = silent
) -> pycolmap.Reconstruction:
    """Adjust a model with the principal points of those cameras that it determines.

    A principal point is determined if its camera took ten of the images, and if the standard deviation of
    both of its coordinates, for errors of one pixel, is at most 0.2 % of the longer side. At most 200
    images are asked.

    Args:
        model: The model; it is not changed.
        cameras: Ids of the cameras that were held alike in all of their images: a picture that was turned
            upright has its principal point elsewhere.
        progress: Progress callback.

    Returns:
        The adjusted model, or the given one if it determines none.
    """
    judged = _with_fewer_images(model)
    counts = Counter(judged.image(i).camera_id for i in judged.reg_image_ids())
    cameras = {camera_id for camera_id in cameras if counts[camera_id] >= _FEWEST}
    if not cameras:
        return model
    with single_step(progress, "adjust principal points"):
        adjusted = _adjusted(model, judged, cameras)
    if any(camera_fault(camera) for camera in adjusted.cameras.values()):
        return model
    return adjusted


def _adjusted(
    model: pycolmap.Reconstruction, judged: pycolmap.Reconstruction, cameras: Set[int]
) -> pycolmap.Reconstruction:
    determined = _determined(judged, cameras)
    if not determined:
        return model
    adjusted = judged
    if determined < cameras or judged.num_reg_images() < model.num_reg_images():
        adjusted = pycolmap.Reconstruction(model)
        _adjust(adjusted, determined)
    adjusted.update_point_3d_errors()
    return adjusted


def _with_fewer_images(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    copy, image_ids = pycolmap.Reconstruction(model), sorted(model.reg_image_ids())
    kept = {image_ids[place] for place in evenly_spaced(len(image_ids), _MOST_JUDGED)}
    for image_id in sorted(set(image_ids) - kept):
        copy.deregister_frame(copy.image(image_id).frame_id)
    return copy


def _determined(model: pycolmap.Reconstruction, cameras: Set[int]) -> frozenset[int]:
    """Which of some cameras have a principal point that a model determines; the model is adjusted."""
    adjuster = _adjust(model, cameras)
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    covariance = pycolmap.estimate_ba_covariance(options, model, adjuster)
    if covariance is None:
        return frozenset()
    return frozenset(i for i in cameras if _deviation(model.camera(i), covariance) <= _MAX_STD)


def _deviation(camera: pycolmap.Camera, covariance: pycolmap.BACovariance) -> float:
    """The larger standard deviation of the principal point, over the longer side."""
    own = covariance.get_other_params_cov(camera.params)
    if own is None:
        return np.inf
    variances = np.diag(own)[list(camera.principal_point_idxs())]
    return float(np.sqrt(variances.max())) / max(camera.width, camera.height)


def _adjust(model: pycolmap.Reconstruction, cameras: Set[int]) -> pycolmap.CeresBundleAdjuster:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    return adjust(model, options, constant_cameras=sorted(set(model.cameras) - cameras))
