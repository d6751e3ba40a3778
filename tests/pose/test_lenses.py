"""Cameras that may exist are accepted, however odd, and cameras that no lens has are not."""

import numpy as np
import pycolmap
import pytest
from lenses import MODELS, distorted

from slimsfm.geometry import project, resized_camera
from slimsfm.lenses import camera_fault

DISTORTED = [model for model in MODELS if len(distorted(model).extra_params_idxs())]

# of published calibrations and data sheets: model, width, height, parameters
REAL = {
    "GoPro": ("OPENCV", 1920, 1080, [870, 870, 960, 540, -0.25, 0.06, 0, 0]),
    "KITTI": ("OPENCV", 1392, 512, [984, 981, 690, 233, -0.37, 0.2, 0.001, 0.0004]),
    "ETH3D": (
        "THIN_PRISM_FISHEYE",
        6048,
        4032,
        [3411, 3410, 3041, 2014, 0.21, 0.211, -5e-6, 0.0005, -0.158, 0.407, -8e-5, 0.0009],
    ),
    "Azure Kinect": (
        "FULL_OPENCV",
        1280,
        720,
        [607, 607, 638, 367, 0.42, -2.5, 0.0008, -0.0002, 1.46, 0.3, -2.33, 1.39],
    ),
    "Aria": (
        "RAD_TAN_THIN_PRISM_FISHEYE",
        1408,
        1408,
        [611, 611, 715, 706, 0.4, -0.46, 0.08, 0.06, 0.19, -0.11, 2e-4, 3e-4, -4e-4, 3e-4, -1e-4, 2e-4],
    ),
    "fisheye of 180 degrees": ("OPENCV_FISHEYE", 1000, 1000, [318, 318, 500, 500, 0, 0, 0, 0]),
    "fisheye circle in a wide frame": ("OPENCV_FISHEYE", 1920, 1080, [309, 309, 960, 540, 0.02, -0.01, 0, 0]),
    "fisheye of 195 degrees": ("EUCM", 1280, 1024, [270, 270, 640, 512, 0.62, 1.1]),
    "telescope": ("SIMPLE_RADIAL", 6000, 4000, [330_000, 3000, 2000, 100]),
    "LINEMOD": ("PINHOLE", 640, 480, [572.4114, 573.57043, 325.7611, 242.54899]),
    "crop beside the axis": ("PINHOLE", 200, 200, [4000, 4000, -3000, 2000]),
    "squeezed": ("PINHOLE", 480, 640, [300, 1100, 240, 320]),
    "wrong in the corners": ("SIMPLE_RADIAL", 1000, 750, [700, 500, 375, -0.5]),
    "COLMAP's guess": ("SIMPLE_RADIAL", 1024, 768, [1228.8, 512, 384, 0]),
}


def camera_of(model, width, height, params):
    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def changed(camera, places, values):
    params = camera.params.copy()
    params[places] = values
    return camera_of(camera.model, camera.width, camera.height, params)


@pytest.mark.parametrize("real", REAL.values(), ids=REAL.keys())
def test_real_cameras_are_possible_in_every_size(real):
    for factor in (0.1, 1.0, 3.0):
        assert camera_fault(resized_camera(camera_of(*real), factor)) is None


@pytest.mark.parametrize("model", MODELS)
def test_mild_distortion_is_possible_and_so_are_its_crops(model):
    lens = distorted(model)
    assert camera_fault(lens) is None
    for x, y in ((-200, 240), (900, 700), (320, -300)):
        assert camera_fault(changed(lens, lens.principal_point_idxs(), (x, y))) is None


@pytest.mark.parametrize("model", DISTORTED)
def test_absurd_distortion_is_impossible(model):
    rng, lens = np.random.default_rng(0), distorted(model)
    places = list(lens.extra_params_idxs())
    for _ in range(40):
        value = rng.choice([-1, 1]) * 10 ** rng.uniform(6, 300)
        place = rng.choice(places)
        assert "distortion" in camera_fault(changed(lens, place, value))
        assert "distortion" in camera_fault(changed(lens, places, value))


@pytest.mark.parametrize("model", MODELS)
def test_absurd_sizes_focal_lengths_and_principal_points_are_impossible(model):
    lens = distorted(model)
    focal, center = lens.focal_length_idxs(), lens.principal_point_idxs()
    for value in (0.0, -500.0, 1e-300, 10.0, 1e7, 1e300):
        assert "focal length" in camera_fault(changed(lens, focal, value))
    for value in (-1e4, 1e4, 1e20, -1e300):
        assert "principal point" in camera_fault(changed(lens, center[0], value))
        assert "principal point" in camera_fault(changed(lens, center[1], value))
    for place in range(len(lens.params)):
        for value in (np.nan, np.inf, -np.inf):
            assert "finite" in camera_fault(changed(lens, place, value))
    for width, height in ((0, 480), (640, 0), (2**40, 480)):
        assert "size" in camera_fault(camera_of(model, width, height, lens.params))


@pytest.mark.parametrize("model", MODELS)
def test_points_behind_the_camera_do_not_project(model):
    points = np.random.default_rng(0).uniform((-1, -1, -3), (1, 1, 3), (200, 3))
    pixels = project(points, pycolmap.Rigid3d(), distorted(model))
    assert np.isnan(pixels[points[:, 2] <= 0]).all()
    assert np.isfinite(pixels[points[:, 2] > 1]).all()


def test_focal_lengths_that_differ_by_far_and_spheres_are_impossible():
    assert "differ too much" in camera_fault(camera_of("PINHOLE", 640, 480, [50, 5000, 320, 240]))
    assert "spherical" in camera_fault(camera_of("EQUIRECTANGULAR", 640, 320, [640, 320]))
