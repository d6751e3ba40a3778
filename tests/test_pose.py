import cv2
import numpy as np
import pycolmap
import pytest

from scenes import BOX, camera, poses
from slimsfm.geometry import corner_error, project, reprojection_errors, rotation_error_deg
from slimsfm.pose import RansacOptions, estimate_pose

MODELS = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"})
# Mild distortion for each kind of parameter; k, p and s are radial, tangential and prism coefficients.
EXTRA = {"k": 0.02, "p": 0.001, "s": 0.001, "omega": 0.3, "alpha": 0.6, "beta": 1.1}


def distorted(model):
    lens = pycolmap.Camera.create_from_model_name(1, model, 500.0, 640, 480)
    names = [name.strip() for name in lens.params_info.split(",")]
    params = lens.params.copy()
    for index in lens.extra_params_idxs():
        kind = names[index] if names[index] in EXTRA else names[index][0]
        params[index] = EXTRA[kind] / (1 + int(names[index][-1]) if names[index][-1].isdigit() else 1)
    lens.params = params
    assert lens.verify_params()
    return lens


def matches(lens, cam_from_world, count=100, outliers=0.0, sigma_px=0.0, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) @ BOX.half_edges
    pixels = project(points, cam_from_world, lens) + sigma_px * rng.normal(size=(count, 2))
    wrong = rng.permutation(count) < outliers * count
    pixels[wrong] = rng.uniform((0, 0), (640, 480), (int(wrong.sum()), 2))
    return pixels, points, wrong


@pytest.mark.parametrize("model", MODELS)
def test_an_exact_pose_is_found_through_every_lens(model):
    lens = distorted(model)
    for cam_from_world in poses(3):
        pixels, points, _ = matches(lens, cam_from_world)
        assert np.isfinite(pixels).all()
        found = estimate_pose(pixels, points, lens)
        assert found.num_inliers == 100
        assert rotation_error_deg(found.cam_from_world, cam_from_world) < 1e-6
        assert corner_error(found.cam_from_world, cam_from_world, BOX) < 1e-6


def test_a_spherical_camera_is_refused():
    lens = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 640, 480)
    pixels, points, _ = matches(camera(), poses(1)[0])
    with pytest.raises(ValueError, match="spherical model EQUIRECTANGULAR"):
        estimate_pose(pixels, points, lens)


@pytest.mark.parametrize("seed", range(5))
def test_half_of_the_matches_may_be_wrong(seed):
    pixels, points, wrong = matches(camera(), poses(7)[seed], 200, outliers=0.5, sigma_px=0.5, seed=seed)
    found = estimate_pose(pixels, points, camera())
    errors = reprojection_errors(pixels, points, poses(7)[seed], camera())
    assert corner_error(found.cam_from_world, poses(7)[seed], BOX) < 5e-3
    assert found.inliers[~wrong].all()
    assert (errors[found.inliers] < 7).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_pose_agrees_with_pycolmap_and_opencv(seed):
    truth = poses(5)[seed]
    lens = camera()
    pixels, points, _ = matches(lens, truth, 200, outliers=0.3, sigma_px=0.5, seed=seed)
    ours = estimate_pose(pixels, points, lens)
    theirs = pycolmap.estimate_and_refine_absolute_pose(
        pixels, points, lens, estimation_options={"ransac": {"max_error": 6.0}}
    )
    assert corner_error(ours.cam_from_world, theirs["cam_from_world"], BOX) < 1e-3
    assert np.mean(ours.inliers == theirs["inlier_mask"]) > 0.98
    fx, fy, cx, cy = lens.params[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    found, rotation, translation, _ = cv2.solvePnPRansac(
        points, pixels, matrix, lens.params[4:], reprojectionError=6.0, iterationsCount=1000
    )
    opencv = pycolmap.Rigid3d(pycolmap.Rotation3d(cv2.Rodrigues(rotation)[0]), translation[:, 0])
    assert found
    assert corner_error(ours.cam_from_world, opencv, BOX) < 5e-3


def test_equal_input_gives_equal_output_and_the_order_of_matches_hardly_counts():
    pixels, points, _ = matches(camera(), poses(5)[1], 200, outliers=0.5, sigma_px=1.0)
    one, two = (estimate_pose(pixels, points, camera()) for _ in range(2))
    assert np.array_equal(one.cam_from_world.matrix(), two.cam_from_world.matrix())
    assert np.array_equal(one.inliers, two.inliers)
    order = np.random.default_rng(1).permutation(200)
    other = estimate_pose(pixels[order], points[order], camera())
    assert corner_error(one.cam_from_world, other.cam_from_world, BOX) < 1e-3


def test_the_unit_of_the_map_does_not_count():
    pixels, points, _ = matches(camera(), poses(5)[2], sigma_px=0.5)
    one, thousand = (estimate_pose(pixels, scale * points, camera()) for scale in (1, 1000))
    assert thousand.cam_from_world.translation == pytest.approx(
        1000 * one.cam_from_world.translation, rel=1e-4
    )


@pytest.mark.parametrize("count", [0, 3, 11])
def test_too_few_matches_give_no_pose(count):
    pixels, points, _ = matches(camera(), poses(5)[0])
    assert estimate_pose(pixels[:count], points[:count], camera()) is None


def test_nothing_but_wrong_matches_give_no_pose():
    pixels, points, _ = matches(camera(), poses(5)[0], outliers=1.0)
    assert estimate_pose(pixels, points, camera(), RansacOptions(max_iterations=500)) is None


def test_pixels_that_no_ray_reaches_are_no_inliers():
    lens = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 150.0, 640, 480)
    truth = poses(5)[0]
    pixels, points, _ = matches(lens, truth)
    pixels[:10] = (1e5, 1e5)
    found = estimate_pose(pixels, points, lens)
    assert found.inliers.tolist() == [False] * 10 + [True] * 90
    assert corner_error(found.cam_from_world, truth, BOX) < 1e-6


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_coordinate_that_is_not_finite_is_named_with_its_row(bad):
    pixels, points, _ = matches(camera(), poses(5)[0])
    points[17, 1] = bad
    with pytest.raises(ValueError, match=r"points3D_in_world must be finite.* in row 17"):
        estimate_pose(pixels, points, camera())
    points[17, 1], pixels[3, 0] = 0, bad
    with pytest.raises(ValueError, match=r"points2D must be finite.* in row 3"):
        estimate_pose(pixels, points, camera())


@pytest.mark.parametrize(
    "values",
    [{"max_error_px": 0.0}, {"max_error_px": float("nan")}, {"min_inliers": 3}, {"max_iterations": 0}],
    ids=str,
)
def test_bad_options_are_named(values):
    with pytest.raises(ValueError, match=next(iter(values))):
        RansacOptions(**values)
