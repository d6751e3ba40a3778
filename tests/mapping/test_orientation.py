"""A model of stored pixels is one of the upright picture, turned, for every camera model."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from slimsfm.errors import ModelError
from slimsfm.features import Features
from slimsfm.mapping.map import Map
from slimsfm.mapping.orientation import (
    mirrored_images,
    stored_model,
    turned_camera,
    turned_features,
    turned_model,
    turned_pixels,
    turned_pose,
)

WIDTH, HEIGHT = 640, 480
RNG = np.random.default_rng(0)
MODELS = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"})
SCALES = {"f": 500, "fx": 500, "fy": 450, "cx": 310, "cy": 255, "alpha": 0.3, "beta": 1.1, "omega": 0.2}


def camera(model: str) -> pycolmap.Camera:
    """A camera without any symmetry: each parameter has a value of its own."""
    made = pycolmap.Camera.create_from_model_name(1, model, 500.0, WIDTH, HEIGHT)
    names = [name.strip() for name in made.params_info.split(",")]
    made.params = [SCALES.get(name, 0.004 + 0.003 * i) for i, name in enumerate(names)]
    return made


@pytest.mark.parametrize("turns", [-1, 0, 1, 2, 3])
@pytest.mark.parametrize("model", MODELS)
def test_a_turned_camera_sees_each_point_at_the_turned_pixel(model: str, turns: int) -> None:
    points3D_in_world = RNG.uniform((-1, -1, 2.5), (1, 1, 5), (50, 3))
    cam_from_world = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.1, -0.2, 0.1])), np.array([0.1, 0, 0.3])
    )
    original, turned = camera(model), turned_camera(camera(model), turns)
    seen = np.asarray(original.img_from_cam(cam_from_world * points3D_in_world))
    now = np.asarray(turned.img_from_cam(turned_pose(cam_from_world, turns) * points3D_in_world))
    assert now == pytest.approx(turned_pixels(seen, (WIDTH, HEIGHT), turns), abs=1e-6)
    assert (turned.width, turned.height) == ((HEIGHT, WIDTH) if turns % 2 else (WIDTH, HEIGHT))
    assert repr(turned_camera(turned, -turns)) == repr(original)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_pixels_turn_as_the_picture_does(turns: int) -> None:
    picture = np.zeros((HEIGHT, WIDTH), bool)
    picture[40, 200] = True
    (row, column) = np.argwhere(np.rot90(picture, -turns))[0]
    turned = turned_pixels(np.array([[200.5, 40.5]]), (WIDTH, HEIGHT), turns)
    assert turned.tolist() == [[column + 0.5, row + 0.5]]


def test_a_camera_of_unknown_parameters_is_refused_by_name() -> None:
    spherical = pycolmap.Camera.create_from_model_name(3, "EQUIRECTANGULAR", 1.0, WIDTH, HEIGHT)
    assert turned_camera(spherical, 0).model_name == "EQUIRECTANGULAR"
    with pytest.raises(ModelError, match=r"camera 3 \(EQUIRECTANGULAR\) cannot be turned"):
        turned_camera(spherical, 1)


def test_features_turn_with_the_picture() -> None:
    features = Features(
        keypoints=np.array([[200.5, 40.5], [0.5, 0.5]], np.float32),
        descriptors=np.eye(2, 128, dtype=np.float32),
        scores=np.ones(2, np.float32),
        image_size=(WIDTH, HEIGHT),
        frames=np.array([[2, 0.0], [3, 3.0]], np.float32),
    )
    turned = turned_features(features, 1)
    assert turned.image_size == (HEIGHT, WIDTH)
    assert turned.keypoints.tolist() == [[HEIGHT - 40.5, 200.5], [HEIGHT - 0.5, 0.5]]
    assert turned.frames is not None
    assert turned.frames[:, 0].tolist() == [2, 3]
    assert turned.frames[:, 1] == pytest.approx([np.pi / 2, 3 + np.pi / 2 - 2 * np.pi])  # x turns into y
    assert np.array_equal(turned.descriptors, features.descriptors)
    back = turned_features(turned, -1)
    assert back.frames is not None
    assert back.keypoints == pytest.approx(features.keypoints)
    assert back.frames[:, 1] == pytest.approx([0, 3], abs=1e-6)


def with_tags(map_: Map, *tags: int) -> Map:
    found = {name: tag for name, tag in zip(map_.images, tags, strict=False) if tag != 1}
    return replace(map_, info=replace(map_.info, exif_orientations=found))


def residuals(model: pycolmap.Reconstruction) -> list[float]:
    """Distances in pixels between keypoints and the points that they see."""
    found = []
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.image(element.image_id)
            pixel = image.project_point(point.xyz)
            assert pixel is not None
            found.append(float(np.linalg.norm(pixel - image.points2D[element.point2D_idx].xy)))
    return found


def test_a_turned_model_is_exact_and_keeps_ids_and_centers(exact: Map) -> None:
    made = stored_model(with_tags(exact, 1, 3, 6, 8, 1, 6))
    assert max(residuals(made)) < 1e-6
    assert sorted(made.points3D) == sorted(exact.model.points3D)
    for image_id, image in exact.model.images.items():
        turned = made.image(image_id)
        assert turned.name == image.name
        assert turned.projection_center() == pytest.approx(image.projection_center())
    assert made.is_valid()


def test_a_camera_of_pictures_held_both_ways_becomes_two(exact: Map) -> None:
    (camera_id,) = {image.camera_id for image in exact.images.values()}
    made = stored_model(with_tags(exact, 1, 6, 6))
    ids = [made.image(image.image_id).camera_id for image in exact.images.values()]
    assert ids[0] == ids[3] == camera_id
    assert ids[1] == ids[2] != camera_id
    all_turned = stored_model(with_tags(exact, *[6] * 6))
    assert sorted(all_turned.cameras) == [camera_id]


def test_a_model_of_stored_or_untagged_pictures_is_not_touched(exact: Map) -> None:
    assert stored_model(exact) is exact.model
    stored = replace(exact, info=replace(exact.info, orientation="stored"))
    assert stored_model(with_tags(stored, 6, 2)) is exact.model


def test_images_without_a_pose_do_not_matter(exact: Map) -> None:
    model = pycolmap.Reconstruction(exact.model)
    image = pycolmap.Image(name="unposed.png", camera_id=1, image_id=99)
    frame = pycolmap.Frame(frame_id=99, rig_id=1)
    frame.add_data_id(image.data_id)
    model.add_frame(frame)
    image.frame_id = 99
    model.add_image(image)
    unposed = replace(exact, model=model)
    assert stored_model(unposed) is model
    assert stored_model(with_tags(unposed, 6)).num_images() == len(exact.images)


@pytest.mark.parametrize("tag", [2, 4, 5, 7])
def test_mirrored_images_are_left_out_and_named(exact: Map, tag: int) -> None:
    map_ = with_tags(exact, tag, 1, 6)
    first = next(iter(map_.images))
    assert mirrored_images(map_) == [first]
    made = stored_model(map_)
    assert first not in {image.name for image in made.images.values()}
    assert made.num_images() == len(exact.images) - 1
    assert max(residuals(made)) < 1e-6
    with pytest.raises(ModelError, match="mirrors"):
        stored_model(with_tags(exact, *[tag] * 6))


def test_images_of_a_rig_of_several_cameras_are_not_turned_one_by_one() -> None:
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for camera_id in (1, 2):
        one = pycolmap.Camera.create_from_model_name(camera_id, "PINHOLE", 500.0, WIDTH, HEIGHT)
        model.add_camera(one)
        if camera_id == 1:
            rig.add_ref_sensor(one.sensor_id)
        else:
            rig.add_sensor(one.sensor_id, pycolmap.Rigid3d())
    model.add_rig(rig)
    cam = pycolmap.Image(name="a", camera_id=1, image_id=1)
    frame = pycolmap.Frame(frame_id=1, rig_id=1)
    frame.add_data_id(cam.data_id)
    frame.rig_from_world = pycolmap.Rigid3d()
    model.add_frame(frame)
    cam.frame_id = 1
    model.add_image(cam)
    model.register_frame(1)
    with pytest.raises(ModelError, match="rigs of several cameras"):
        turned_model(model, {"a": 1})
