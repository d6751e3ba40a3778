import numpy as np
import pycolmap
import pytest
from runs import make_run

from slimsfm.evaluation.results import Run
from slimsfm.features import Features
from slimsfm.geometry import Box
from slimsfm.mapping.info import MapInfo
from slimsfm.mapping.map import Map
from slimsfm.mapping.subset import keep_images
from slimsfm.report import report_html

BOX = Box(np.zeros(3), np.diag([0.5, 0.4, 0.3]))


def looking_at_origin(angle):
    """A camera at distance 3 from the origin, rotated about the vertical, its y axis along the world's -z."""
    back = np.array([np.cos(angle), np.sin(angle), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    rotation = np.stack([np.cross(down, -back), down, -back])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0.0, 0.0, 3.0]))


@pytest.fixture(scope="session")
def camera():
    return pycolmap.Camera.create_from_model_name(1, "PINHOLE", 300.0, 320, 240)


@pytest.fixture(scope="session")
def full(camera):
    rng = np.random.default_rng(0)
    points3D = rng.uniform(-0.3, 0.3, (30, 3))
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    features = {}
    for image_id in range(1, 5):
        pose = looking_at_origin(0.4 * image_id)
        keypoints = camera.img_from_cam(pose * points3D)
        name = f"{image_id}.jpg"
        image = pycolmap.Image(name=name, camera_id=1, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in keypoints])
        model.add_image_with_trivial_frame(image, pose)
        features[name] = Features(
            keypoints=keypoints.astype(np.float32),
            descriptors=rng.random((30, 8), dtype=np.float32),
            scores=np.ones(30, np.float32),
            image_size=(320, 240),
        )
    for row, xyz in enumerate(points3D):
        seen_by = range(1, 5) if row < 20 else (3, 4)
        track = pycolmap.Track([pycolmap.TrackElement(image_id, row) for image_id in seen_by])
        model.add_point3D(xyz, track, rng.integers(0, 256, 3).astype(np.uint8))
    info = MapInfo(extractor="sift", box=BOX, box_source="given", origin="made in a test")
    return Map(model=model, features=features, info=info)


@pytest.fixture(scope="session")
def reduced(full):
    return keep_images(full, ["2.jpg"])


@pytest.fixture(scope="session")
def run(tmp_path_factory) -> Run:
    """A run of two objects; tests must not change its folder."""
    return make_run(tmp_path_factory.mktemp("run"), {"can": 10, "mug": 11})


@pytest.fixture(scope="session")
def html(run) -> str:
    """The page of that run."""
    return report_html(run)
