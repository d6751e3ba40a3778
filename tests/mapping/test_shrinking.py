"""Results are those of the pixels in which features were found, however large the photos are."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from scenes import camera
from slimsfm.features import Features, shrink_factor
from slimsfm.geometry import corner_error, project, resized_camera
from slimsfm.graph.compute import compute_graph
from slimsfm.graph.edge_sources import GraphOptions
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.mapping.build import BuildOptions, build_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.shrinking import ShrunkImages
from slimsfm.photos import read_image

TIMES = 4
SIZE = 320  # of the rendered photos, and in which features are found


def enlarged(image):
    return cv2.resize(image, None, fx=TIMES, fy=TIMES, interpolation=cv2.INTER_NEAREST)


@pytest.fixture(scope="module")
def large(rendered, tmp_path_factory) -> Map:
    """A map of the rendered photos, four times as large."""
    folder = tmp_path_factory.mktemp("large")
    for name in rendered.names:
        (folder / name).parent.mkdir(exist_ok=True)
        Image.fromarray(enlarged(read_image(rendered.folder / name))).save(folder / name, compress_level=1)
    return build_map(folder, BuildOptions(max_image_size=SIZE))


def test_photos_of_any_size_give_the_same_points_and_poses(large, unposed):
    small = unposed.map
    assert list(large.images) == list(small.images)
    assert len(large.point3D_ids) == pytest.approx(len(small.point3D_ids), rel=0.05)
    centers = [
        np.array([image.projection_center() for image in map_.images.values()]) for map_ in (large, small)
    ]
    same = pycolmap.estimate_sim3d(*centers)
    distances = np.linalg.norm(same * centers[0] - centers[1], axis=1)
    assert distances.max() < 0.02 * np.linalg.norm(centers[1] - centers[1].mean(axis=0), axis=1).max()
    whole, part = large.shared_camera, small.shared_camera
    assert (whole.width, whole.height) == (TIMES * SIZE, TIMES * 240)
    assert whole.mean_focal_length() == pytest.approx(TIMES * part.mean_focal_length(), rel=0.02)


def test_a_model_of_shrunk_photos_is_in_pixels_of_the_photos(large):
    for name, seen in large.observations.items():
        pixels = project(large.points3D_in_world, large.images[name].cam_from_world(), large.camera(name))
        keypoints = np.array([point.xy for point in large.images[name].points2D])
        assert np.array_equal(keypoints, large.features[name].keypoints)
        errors = np.linalg.norm(pixels[seen.points] - keypoints[seen.rows], axis=1)
        assert np.median(errors) < TIMES / 2
        assert large.features[name].image_size == (TIMES * SIZE, TIMES * 240)
    means = [point.error for point in large.model.points3D.values()]
    large.model.update_point_3d_errors()
    assert np.array_equal(means, [point.error for point in large.model.points3D.values()])


def test_photos_of_several_sizes_are_shrunk_by_a_factor_each_and_known_cameras_stay(
    rendered, posed, tmp_path
):
    known, factors = rendered.known, [1, 2, 4, 1, 3, 1, 2, 1]
    cameras = {}
    for name, factor in zip(rendered.names, factors, strict=True):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cameras[name] = resized_camera(known.cameras[name], factor)
        cameras[name].camera_id = factor
        image = cv2.resize(read_image(rendered.folder / name), None, fx=factor, fy=factor, interpolation=0)
        Image.fromarray(image).save(tmp_path / name, compress_level=1)
    made = build_map(tmp_path, BuildOptions(max_image_size=SIZE), known=replace(known, cameras=cameras))
    for name, lens in cameras.items():
        assert np.array_equal(made.camera(name).params, lens.params)
        assert (made.camera(name).width, made.camera(name).height) == (lens.width, lens.height)
    assert len(made.point3D_ids) == pytest.approx(len(posed.map.point3D_ids), rel=0.1)


@pytest.mark.parametrize("focal", ["known", "unknown"])
def test_queries_of_any_size_are_localized_alike(unposed, rendered, focal):
    small = unposed.map
    options = {**small.info.extractor_options, "max_image_size": SIZE}
    map_ = replace(small, info=replace(small.info, extractor_options=options))
    localizer = Localizer(map_, LocalizationOptions(focal=focal, min_confidence=0.0))
    image = rendered.take.frame(8)
    lens = small.shared_camera
    one, other = (
        localizer.localize(picture, resized_camera(lens, factor))
        for picture, factor in ((image, 1), (enlarged(image), TIMES))
    )
    assert corner_error(one.pose.cam_from_world, other.pose.cam_from_world, map_.box) < 0.02
    assert other.pose.num_inliers == pytest.approx(one.pose.num_inliers, rel=0.05)
    assert other.pose.confidence == pytest.approx(one.pose.confidence, abs=0.05)
    assert other.predicted_corner_error == pytest.approx(one.predicted_corner_error, rel=0.2)
    assert other.points2D.max() > 2 * SIZE
    assert other.camera.width == TIMES * SIZE
    assert other.camera.mean_focal_length() == pytest.approx(TIMES * one.camera.mean_focal_length(), rel=0.02)
    near = localizer.localize_near(enlarged(image), resized_camera(lens, TIMES), one.pose.cam_from_world)
    assert corner_error(one.pose.cam_from_world, near.pose.cam_from_world, map_.box) < 0.02


def scaled(map_: Map, factor: float, max_image_size: int) -> Map:
    """The same map of photos larger by a factor."""
    model = pycolmap.Reconstruction()
    for camera_id, one in map_.model.cameras.items():
        lens = resized_camera(one, factor)
        lens.camera_id = camera_id
        model.add_camera_with_trivial_rig(lens)
    features = {}
    for image_id, image in sorted(map_.model.images.items()):
        seen = map_.features[image.name]
        features[image.name] = replace(
            seen,
            keypoints=(factor * seen.keypoints).astype(np.float32),
            image_size=tuple(round(factor * side) for side in seen.image_size),
        )
        keypoints = features[image.name].keypoints.astype(np.float64)
        copy = pycolmap.Image(
            name=image.name, keypoints=keypoints, camera_id=image.camera_id, image_id=image_id
        )
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in map_.model.points3D.values():
        model.add_point3D(point.xyz, point.track, point.color)
    info = replace(map_.info, extractor_options={"max_image_size": max_image_size})
    return replace(map_, model=model, features=features, info=info)


def test_which_image_localizes_which_does_not_depend_on_their_size(exact):
    """With noise that only the larger pixels make small."""
    noise = np.random.default_rng(0).normal(scale=2.0, size=(1000, 2)).astype(np.float32)
    noisy = {
        name: replace(seen, keypoints=seen.keypoints + noise[: len(seen)])
        for name, seen in exact.features.items()
    }
    small = scaled(replace(exact, features=noisy), 1, 640)
    graphs = [
        compute_graph(one, GraphOptions(edges="matches")).graph for one in (small, scaled(small, 8, 640))
    ]
    assert graphs[0].errors.data == pytest.approx(graphs[1].errors.data, abs=1e-4)
    assert np.isfinite(graphs[0].errors.data).all()


def test_a_resized_camera_sees_the_resized_image():
    points, pose = np.random.default_rng(0).normal(size=(20, 3)), pycolmap.Rigid3d()
    pose.translation = np.array([0, 0, 8])
    for factor in (0.25, 1, 3):
        pixels = project(points, pose, resized_camera(camera(), factor))
        assert pixels == pytest.approx(factor * project(points, pose, camera()))
    assert np.array_equal(resized_camera(camera(), 1).params, camera().params)


def test_only_images_larger_than_the_extractor_takes_are_shrunk():
    options = {"max_image_size": 1000}
    assert [shrink_factor(options, *size) for size in ((1000, 9), (9, 800), (9, 2500))] == [1, 1, 2.5]
    assert shrink_factor({}, 5000, 5000) == shrink_factor({"max_image_size": None}, 5000, 5000) == 1


def test_what_is_not_shrunk_is_unchanged_to_the_bit():
    keypoints = np.random.default_rng(0).uniform(0, 600, (50, 2)).astype(np.float32)
    features = Features(
        keypoints=keypoints,
        descriptors=np.zeros((50, 4), np.uint8),
        scores=np.ones(50, np.float32),
        image_size=(640, 480),
    )
    shrunk = ShrunkImages.by_extractor({"a": features}, {"a": camera()}, {"max_image_size": 640})
    assert np.array_equal(shrunk.features["a"].keypoints, keypoints)
    assert repr(shrunk.cameras["a"]) == repr(camera())
