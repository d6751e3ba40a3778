import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from scenes import BOX, camera, poses
from slimsfm.geometry import (
    BOX_EDGES,
    Box,
    corner_error,
    project,
    reprojection_errors,
    resized_camera,
    rotation_error_deg,
    translation_error,
)

SEEDS = st.integers(0, 2**32 - 1)


def random_box(rng):
    axes = Rotation.random(rng=rng).as_matrix()
    return Box(rng.normal(size=3) * 10, rng.uniform(0.1, 5, (3, 1)) * axes)


def random_pose(rng):
    return pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.random(rng=rng).as_quat()), rng.normal(size=3))


@given(seed=SEEDS, order=st.permutations(range(8)))
def test_box_is_found_from_its_corners_in_any_order(seed, order):
    box = random_box(np.random.default_rng(seed))
    found = Box.from_corners(box.corners[list(order)])
    gaps = np.linalg.norm(found.corners[:, None] - box.corners[None], axis=2)
    assert np.array_equal(np.sort(gaps.argmin(axis=1)), np.arange(8))
    assert gaps.min(axis=1).max() < 1e-12 * (1 + np.abs(box.corners).max())
    assert found.diagonal == pytest.approx(box.diagonal)


@given(seed=SEEDS)
def test_diagonal_is_the_largest_distance_between_corners(seed):
    box = random_box(np.random.default_rng(seed))
    distances = np.linalg.norm(box.corners[:, None] - box.corners[None], axis=2)
    assert box.diagonal == pytest.approx(distances.max())
    assert box.corners.mean(axis=0) == pytest.approx(box.center)


@given(seed=SEEDS)
def test_points_that_are_not_the_corners_of_a_box_are_rejected(seed):
    rng = np.random.default_rng(seed)
    corners = random_box(rng).corners
    corners[int(rng.integers(8))] += np.ptp(corners, axis=0)
    with pytest.raises(ValueError, match="corners of a box"):
        Box.from_corners(corners)


@pytest.mark.parametrize(
    "corners", [np.zeros((7, 3)), np.zeros((8, 3)), np.full((8, 3), np.nan)], ids=["seven", "point", "nan"]
)
def test_degenerate_corners_are_rejected(corners):
    with pytest.raises(ValueError, match=r"corners|half_edges"):
        Box.from_corners(corners)


def test_box_has_twelve_edges_in_three_directions():
    directions = [tuple(np.abs(BOX.corners[i] - BOX.corners[j]).round(9)) for i, j in BOX_EDGES]
    assert len(BOX_EDGES) == 12
    assert sorted({d: directions.count(d) for d in directions}.items()) == [
        ((0.0, 0.0, 1.2), 4),
        ((0.0, 1.6, 0.0), 4),
        ((2.0, 0.0, 0.0), 4),
    ]


@given(seed=SEEDS)
def test_corner_error_is_a_metric(seed):
    rng = np.random.default_rng(seed)
    a, b, c = (random_pose(rng) for _ in range(3))
    box = random_box(rng)
    assert corner_error(a, a, box) == 0
    assert corner_error(a, b, box) == corner_error(b, a, box) > 0
    assert corner_error(a, c, box) <= corner_error(a, b, box) + corner_error(b, c, box) + 1e-12


@given(seed=SEEDS, scale=st.floats(1e-3, 1e3))
def test_corner_error_does_not_depend_on_the_unit(seed, scale):
    rng = np.random.default_rng(seed)
    a, b = random_pose(rng), random_pose(rng)
    box = random_box(rng)
    scaled = [pycolmap.Rigid3d(pose.rotation, scale * pose.translation) for pose in (a, b)]
    scaled_box = Box(scale * box.center, scale * box.half_edges)
    assert corner_error(*scaled, scaled_box) == pytest.approx(corner_error(a, b, box))


def test_translation_by_the_diagonal_is_an_error_of_one():
    shift = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0, BOX.diagonal, 0]))
    assert corner_error(pycolmap.Rigid3d(), shift, BOX) == pytest.approx(1)


@given(seed=SEEDS)
def test_rotation_error_agrees_with_scipy(seed):
    a, b = (random_pose(np.random.default_rng([seed, i])) for i in range(2))
    expected = Rotation.from_quat(a.rotation.quat).inv() * Rotation.from_quat(b.rotation.quat)
    assert rotation_error_deg(a, b) == pytest.approx(np.degrees(expected.magnitude()), abs=1e-9)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-9, 1e-6, 90.0, 179.9999999, 180.0])
def test_rotation_error_is_exact_near_0_and_180_degrees(angle_deg):
    axis = np.array([2.0, -1.0, 2.0]) / 3
    start = random_pose(np.random.default_rng(0))
    turn = pycolmap.Rotation3d(axis * np.radians(angle_deg))
    turned = pycolmap.Rigid3d(turn * start.rotation, start.translation)
    assert rotation_error_deg(start, turned) == pytest.approx(angle_deg, rel=1e-6, abs=1e-12)
    assert translation_error(start, turned) == 0


def test_projection_agrees_with_opencv():
    lens, cam_from_world = camera("OPENCV"), poses(5)[3]
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    fx, fy, cx, cy = lens.params[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rotation = cv2.Rodrigues(cam_from_world.rotation.matrix())[0]
    expected = cv2.projectPoints(points, rotation, cam_from_world.translation, matrix, lens.params[4:])[0]
    assert project(points, cam_from_world, lens) == pytest.approx(expected[:, 0], abs=1e-9)


def test_projection_through_a_fisheye_agrees_with_opencv():
    lens, cam_from_world = camera("OPENCV_FISHEYE"), poses(5)[2]
    lens.params = np.array([500.0, 505.0, 322.0, 238.0, 0.05, -0.01, 0.002, 0.001])
    points = np.random.default_rng(1).uniform(-1, 1, (50, 3))
    matrix = np.array([[500.0, 0, 322], [0, 505, 238], [0, 0, 1]])
    rotation = cv2.Rodrigues(cam_from_world.rotation.matrix())[0]
    expected = cv2.fisheye.projectPoints(
        points[:, None], rotation, cam_from_world.translation, matrix, lens.params[4:]
    )[0]
    assert project(points, cam_from_world, lens) == pytest.approx(expected[:, 0], abs=1e-9)


def test_point_behind_the_camera_has_no_projection_and_an_infinite_error():
    points = np.array([[0.0, 0, 2], [0, 0, -2]])
    pixels = project(points, pycolmap.Rigid3d(), camera())
    errors = reprojection_errors(np.full((2, 2), 240.0), points, pycolmap.Rigid3d(), camera())
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1]).all()
    assert np.isfinite(errors[0])
    assert errors[1] == np.inf


def test_projecting_no_points_gives_no_pixels():
    assert project(np.zeros((0, 3)), pycolmap.Rigid3d(), camera()).shape == (0, 2)


def test_a_resized_image_has_a_pixel_at_least():
    thin = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 500.0, 100_000, 1)
    small = resized_camera(thin, 0.01)
    assert (small.width, small.height) == (1000, 1)
