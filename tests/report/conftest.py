import numpy as np
import pycolmap
import pytest

from slimsfm.evaluation.metrics import Scores
from slimsfm.evaluation.table import Row
from slimsfm.features import Features
from slimsfm.geometry import Box
from slimsfm.localization import Seconds
from slimsfm.mapping.map import Map, MapInfo
from slimsfm.mapping.subset import keep_images

BOX = Box(np.zeros(3), np.diag([0.5, 0.4, 0.3]))


def looking_at_origin(angle):
    """A camera 3 before the origin, turned about the vertical, its y axis down along the world's -z."""
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
def make_row():
    def make(variant, *, strategy="exhaustive", match=0.1, add=97.0, median=0.01, deg_cm=None, **sizes):
        scores = Scores(
            queries=25,
            localized=100.0,
            add={0.1: add, 0.05: 90.0, 0.02: 70.0},
            median_corner_error=median,
            deg_cm=deg_cm,
            confidence_wrong=0.02,
            references_tried=3.0,
            seconds=Seconds(extract=0.03, match=match, pose=0.004),
        )
        sizes = {"references": 4.0, "points": 30.0, "map_bytes": 2.4e7, **sizes}
        return Row(object="toy", strategy=strategy, variant=variant, scores=scores, **sizes)

    return make
