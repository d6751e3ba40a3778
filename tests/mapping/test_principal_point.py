import numpy as np
import pycolmap
import pytest

from slimsfm.geometry import project
from slimsfm.mapping import principal_point as principal_point_module
from slimsfm.mapping.model import positions
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


def test_images_without_poses_do_no_harm(model):
    """As they are left where a model fell into pieces."""
    some = pycolmap.Reconstruction(model)
    some.deregister_frame(some.image(3).frame_id)
    adjusted = with_principal_points(some, {1})
    assert principal_point(adjusted) == pytest.approx(OFF, abs=0.01)
    assert adjusted.num_reg_images() == 19


def test_a_part_of_many_images_decides_for_all_of_them(model, monkeypatch):
    monkeypatch.setattr(principal_point_module, "_MOST_JUDGED", 15)
    adjusted = with_principal_points(model, {1})
    assert adjusted.num_reg_images() == 20
    assert principal_point(adjusted) == pytest.approx(OFF, abs=0.01)


def test_equal_models_give_equal_bytes(model):
    one, other = (with_principal_points(model, {1}) for _ in range(2))
    assert one.cameras[1].params.tobytes() == other.cameras[1].params.tobytes()


def test_cameras_that_were_not_held_alike_keep_the_center(model):
    assert with_principal_points(model, set()) is model


def test_a_camera_of_few_images_keeps_the_center_beside_one_of_many(model):
    two = pycolmap.Reconstruction(model)
    other = pycolmap.Camera(two.cameras[1].todict())
    other.camera_id = 2
    two.add_camera_with_trivial_rig(other)
    for image_id in range(1, 6):
        copy = two.image(image_id)
        lone = pycolmap.Image(
            name=f"lone{image_id}.png", keypoints=positions(copy), camera_id=2, image_id=100 + image_id
        )
        two.add_image_with_trivial_frame(lone, copy.cam_from_world())
        for row, point_id in enumerate(sorted(two.point3D_ids())):
            two.add_observation(point_id, pycolmap.TrackElement(100 + image_id, row))
    adjusted = with_principal_points(two, {1, 2})
    assert adjusted.cameras[2].principal_point_x == 320
    assert abs(adjusted.cameras[1].principal_point_x - OFF[0]) < 2


def test_few_images_determine_nothing():
    few = around(9)
    assert with_principal_points(few, {1}) is few


def test_a_flat_thing_seen_from_the_front_determines_nothing():
    points = np.random.default_rng(0).uniform(-1, 1, (120, 3)) * (1, 1, 0.01)
    eyes = [(0.3 * np.cos(a), 0.3 * np.sin(a), -3.5) for a in np.linspace(0, 6, 20)]
    flat = scene(eyes, points, noise_px=0.3)
    assert with_principal_points(flat, {1}) is flat
