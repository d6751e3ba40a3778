"""Adjust a whole map again, in the frame that it had, and measure how far its images moved."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.errors import ReconstructionError
from slimsfm.geometry import corner_error
from slimsfm.lenses import camera_fault
from slimsfm.mapping.map import Map
from slimsfm.mapping.sfm import adjust
from slimsfm.upkeep.shrunk import shrunk_model, take_cameras


@dataclass(frozen=True, kw_only=True)
class Movement:
    """How far the old images of a map moved when it was adjusted."""

    median: float
    """Median relative corner error between the poses before and after."""

    largest: float
    """Largest of these."""

    image: str
    """The image that moved most."""


def refined(map: Map, before: Map) -> tuple[Map, Movement]:
    """Adjust all poses, points and cameras of a map.

    The result is moved, turned and scaled so that the cameras of the old images are as near as possible to
    where they were, in least squares.

    Args:
        map: The map.
        before: The map before it was extended.

    Returns:
        The adjusted map, and how far the images of `before` moved.

    Raises:
        ReconstructionError: A camera would become impossible.
    """
    work = shrunk_model(map.model, map.info.extractor_options)
    adjust(work, pycolmap.BundleAdjustmentOptions())
    model = pycolmap.Reconstruction(map.model)
    _take_over(work, model)
    take_cameras(work, model, sorted(model.cameras), map.info.extractor_options)
    if any(camera_fault(camera) for camera in model.cameras.values()):
        raise ReconstructionError("adjusting the map gives impossible cameras; leave `refine` off")
    old = [image.image_id for image in before.images.values()]
    target: Float64[np.ndarray, "n 3"] = np.array([before.model.image(i).projection_center() for i in old])
    found = np.array([model.image(i).projection_center() for i in old])
    aligned = pycolmap.estimate_sim3d(found, target)
    if aligned is not None:
        model.transform(aligned)
    model.update_point_3d_errors()
    moved = replace(map, model=model)
    errors = {
        name: corner_error(moved.images[name].cam_from_world(), image.cam_from_world(), before.box)
        for name, image in before.images.items()
    }
    image = max(errors, key=lambda name: errors[name])
    return moved, Movement(median=float(np.median(list(errors.values()))), largest=errors[image], image=image)


def _take_over(work: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> None:
    """Copy poses and points from an adjusted model."""
    for frame_id in sorted(work.reg_frame_ids()):
        model.frame(frame_id).rig_from_world = work.frame(frame_id).rig_from_world
    for point_id in sorted(work.point3D_ids()):
        model.point3D(point_id).xyz = work.point3D(point_id).xyz
