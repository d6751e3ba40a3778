"""Principal points, adjusted where the photos determine them.

Incremental mapping keeps the principal point of a camera in the middle of the image, because few photos do
not determine it. The lens of a phone is off by up to 3 % of the side, and focal length, poses and points make
up for it. Many photos that show the same things from different sides do determine it.
"""

from collections import Counter
from collections.abc import Sequence, Set

import numpy as np
import pycolmap
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order

from slimsfm.lenses import camera_fault
from slimsfm.mapping.model import positions
from slimsfm.mapping.quality import MIN_COMMON_POINTS
from slimsfm.mapping.sfm import adjust
from slimsfm.mapping.support import common_points
from slimsfm.progress import ProgressBar, silent, single_step

_MAX_STD = 2e-3  # of a principal point that counts as determined, over the longer side of the image
_FEWEST = 10  # images of a camera
_MOST_JUDGED = 200  # images by which it is decided
_TWO_VIEWS = 2  # of a point


def with_principal_points(
    model: pycolmap.Reconstruction, cameras: Set[int], progress: ProgressBar = silent
) -> pycolmap.Reconstruction:
    """Adjust a model with the principal points of those cameras that it determines.

    A principal point is determined if its camera took ten of the images, and if the standard deviation of
    both of its coordinates, for errors of one pixel, is at most 0.2 % of the longer side. Of large models,
    200 images decide: those that are linked most directly to the image that sees the most points.

    Args:
        model: The model; it is not changed.
        cameras: Ids of the cameras that were held alike in all of their images: a picture that was turned
            upright has its principal point elsewhere.
        progress: Progress callback.

    Returns:
        The adjusted model, or the given one if it determines none.
    """
    judged = _of_images(model, _linked_images(model))
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


def _linked_images(model: pycolmap.Reconstruction) -> list[int]:
    """Ids of the images that decide."""
    image_ids = sorted(model.reg_image_ids())
    if len(image_ids) <= _MOST_JUDGED:
        return image_ids
    common = common_points(model, [model.image(image_id).name for image_id in image_ids])
    start = int(np.argmax(common.diagonal()))
    links = csr_array(common >= MIN_COMMON_POINTS)
    nearest = breadth_first_order(links, start, directed=False, return_predecessors=False)
    return sorted(image_ids[place] for place in nearest[:_MOST_JUDGED].tolist())


def _of_images(model: pycolmap.Reconstruction, image_ids: Sequence[int]) -> pycolmap.Reconstruction:
    """A copy with some of the posed images, and the points that two of them see."""
    copy = pycolmap.Reconstruction()
    for camera_id in sorted({model.image(image_id).camera_id for image_id in image_ids}):
        copy.add_camera_with_trivial_rig(model.camera(camera_id))
    for image_id in image_ids:
        image = model.image(image_id)
        own = pycolmap.Image(
            name=image.name, keypoints=positions(image), camera_id=image.camera_id, image_id=image_id
        )
        copy.add_image_with_trivial_frame(own, image.cam_from_world())
    for point_id in sorted(model.point3D_ids()):
        point = model.point3D(point_id)
        track = [one for one in point.track.elements if one.image_id in copy.images]
        if len(track) >= _TWO_VIEWS:
            kept = pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error)
            kept.track = pycolmap.Track(track)
            copy.add_point3D_with_id(point_id, kept)
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
