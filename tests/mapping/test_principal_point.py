import numpy as np
import pycolmap
import pytest

from slimsfm.geometry import project
from slimsfm.mapping.principal_point import with_principal_points
from slimsfm.synthetic.scene import look_at

OFF = 326.5, 231.0


def scene(eyes, points, noise_px=0.0):
    """A model whose images have a principal point OFF the center, and whose camera has it in the center."""
    rng, model = np.random.default_rng(0), pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 500.0, 640, 480)
    model.add_camera_with_trivial_rig(camera)
    true = pycolmap.Camera(camera.todict())
    true.principal_point_x, true.principal_point_y = OFF
    tracks = [pycolmap.Track() for _ in points]
    for image_id, eye in enumerate(eyes, start=1):
        pose = look_at(np.asarray(eye), np.zeros(3))
        keypoints = project(points, pose, true) + rng.normal(0, noise_px, (len(points), 2))
        image = pycolmap.Image(name=f"{image_id:03}.png", keypoints=keypoints, camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, pose)
        for row, track in enumerate(tracks):
            track.add_element(image_id, row)
    for point, track in zip(points, tracks, strict=True):
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


def around(count):
    angles = 2 * np.pi * np.arange(count) / count
    points = np.random.default_rng(0).uniform(-1, 1, (600, 3))
    return scene([(3.5 * np.cos(a), 3.5 * np.sin(a), 2 - i % 5) for i, a in enumerate(angles)], points)


def principal_point(model):
    (camera,) = model.cameras.values()
    return camera.principal_point_x, camera.principal_point_y


@pytest.fixture(scope="module")
def model():
    return around(20)


def test_a_principal_point_that_the_images_determine_is_found_and_the_given_model_stays(model):
    adjusted = with_principal_points(model, {1})
    assert principal_point(adjusted) == pytest.approx(OFF, abs=0.01)
    assert adjusted.cameras[1].focal_length == pytest.approx(500, abs=0.01)
    assert adjusted.compute_mean_reprojection_error() < 0.01
    assert principal_point(model) == (320, 240)


def test_equal_models_give_equal_bytes(model):
    one, other = (with_principal_points(model, {1}) for _ in range(2))
    assert one.cameras[1].params.tobytes() == other.cameras[1].params.tobytes()


def test_other_cameras_stay_as_they_are(model):
    assert with_principal_points(model, set()) is model


def test_few_images_determine_nothing():
    few = around(9)
    assert with_principal_points(few, {1}) is few


def test_a_flat_thing_seen_from_the_front_determines_nothing():
    points = np.random.default_rng(0).uniform(-1, 1, (120, 3)) * (1, 1, 0.01)
    eyes = [(0.3 * np.cos(a), 0.3 * np.sin(a), -3.5) for a in np.linspace(0, 6, 20)]
    flat = scene(eyes, points, noise_px=0.3)
    assert with_principal_points(flat, {1}) is flat
