from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from rendered import Rendered, rendered
from slimsfm.mapping.map import Map


@pytest.fixture(scope="session")
def boulder(tmp_path_factory) -> Rendered:
    return rendered(tmp_path_factory.getbasetemp() / "rendered")


@pytest.fixture(scope="session")
def two_cameras(exact) -> Map:
    """The exact scene with another camera of the same size for the first image."""
    model = pycolmap.Reconstruction()
    for camera_id in (1, 2):
        camera = pycolmap.Camera(exact.shared_camera.todict())
        camera.camera_id = camera_id
        camera.params = camera.params * np.array([camera_id, camera_id, 1, 1, 1, 1, 1, 1])
        model.add_camera_with_trivial_rig(camera)
    for image_id, image in enumerate(exact.images.values(), start=1):
        keypoints = exact.features[image.name].keypoints.astype(float)
        camera_id = 2 if image_id == 1 else 1
        copy = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    return replace(exact, model=model)
