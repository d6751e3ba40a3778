import numpy as np
import pycolmap
import pytest

from slimsfm.geometry import project
from slimsfm.synthetic.scene import look_at, mapping_path, query_path

CAMERA = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[600, 600, 324, 237])


def eyes(path):
    return np.array([pose.inverse().translation for pose in path])


def elevations_deg(path):
    return np.degrees(np.arcsin(eyes(path)[:, 2] / np.linalg.norm(eyes(path), axis=1)))


def azimuths_deg(path):
    return np.degrees(np.arctan2(eyes(path)[:, 1], eyes(path)[:, 0]))


def test_a_camera_stands_at_its_eye_and_sees_the_target_upright_at_its_center():
    eye, target = np.array([0.3, -0.5, 0.4]), np.array([0.02, 0.01, -0.03])
    pose = look_at(eye, target)
    assert np.allclose(pose.inverse().translation, eye)
    (center, above) = project(np.array([target, target + np.array([0, 0, 0.01])]), pose, CAMERA)
    assert np.allclose(center, (324, 237))
    assert abs(above[0] - 324) < 1e-9
    assert above[1] < 237


def test_a_positive_roll_turns_the_picture_counterclockwise():
    pose = look_at(np.array([0.5, 0.0, 0.0]), np.zeros(3), roll_deg=90.0)
    above = project(np.array([[0.0, 0.0, 0.01]]), pose, CAMERA)[0]
    assert above[0] < 324
    assert abs(above[1] - 237) < 1e-9


def test_a_vertical_view_is_an_error():
    with pytest.raises(ValueError, match="must not be straight above"):
        look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))


@pytest.mark.parametrize("frames", [20, 60])
def test_the_mapping_path_covers_the_upper_hemisphere(frames):
    path = mapping_path(frames, 0.5)
    assert len(path) == frames
    assert elevations_deg(path).min() < 14
    assert elevations_deg(path).max() > 66
    assert np.diff(np.sort(azimuths_deg(path))).max() < 45
    assert np.allclose(np.linalg.norm(eyes(path), axis=1), 0.5, rtol=0.09)


def test_the_query_path_goes_around_the_object_on_other_positions():
    query, mapping = query_path(np.random.default_rng(0), 40, 0.6), mapping_path(60, 0.5)
    gaps = np.linalg.norm(eyes(query)[:, None] - eyes(mapping)[None], axis=2).min(axis=1)
    assert np.diff(np.sort(azimuths_deg(query))).max() < 20
    assert np.median(gaps) > 0.08
    assert np.ptp(np.linalg.norm(eyes(query), axis=1)) > 0.2
