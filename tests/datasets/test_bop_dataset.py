import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from slimsfm.datasets.bop import Bop
from slimsfm.errors import InputError

OURS, OTHER = 5, 8
NAME = "obj_000005"


def intrinsics(image):
    return np.array([[900.0 + image, 0, 40.5], [0, 910.0, 30.25 + image], [0, 0, 1]])


def instance(known, number, image):
    """An object that is seen under a pose, as scene_gt.json has it."""
    pose = known.poses[image].matrix()
    turned, moved = pose[:, :3].ravel().tolist(), (1000 * pose[:, 3]).tolist()
    return {"cam_R_m2c": turned, "cam_t_m2c": moved, "obj_id": number}


@pytest.fixture
def write_scene(known, write_image):
    """Writes a scene; image k shows our object under pose k unless it is said what is in it."""

    def write(folder, contents, seen=None, names="rgb/{:06d}.png"):
        folder.mkdir(parents=True)
        ground_truth, cameras, info = {}, {}, {}
        for image, numbers in contents.items():
            write_image(folder / names.format(image), 80, 60)
            ground_truth[str(image)] = [instance(known, number, image) for number in numbers]
            cameras[str(image)] = {"cam_K": intrinsics(image).ravel().tolist(), "depth_scale": 1.0}
            info[str(image)] = [{"visib_fract": (seen or {}).get(image, 1.0)} for _ in numbers]
        (folder / "scene_gt.json").write_text(json.dumps(ground_truth))
        (folder / "scene_camera.json").write_text(json.dumps(cameras))
        if seen is not None:
            (folder / "scene_gt_info.json").write_text(json.dumps(info))

    return write


@pytest.fixture
def published(tmp_path, known, write_scene, write_ply):
    write_scene(tmp_path / "train_real" / "000002", {10: [OURS], 2: [OURS], 3: [OTHER]})
    write_scene(tmp_path / "train_real" / "000001", {0: [OURS]}, names="rgb/{:06d}.jpg")
    seen = {4: 0.09, 5: 0.1}
    contents = {4: [OURS], 5: [OTHER, OURS], 6: [OURS, OURS], 7: [OTHER], 8: []}
    write_scene(tmp_path / "test" / "000002", contents, seen)
    low, size = 1000 * known.box.corners.min(axis=0), 1000 * np.ptp(known.box.corners, axis=0)
    listed = {f"min_{axis}": low[k] for k, axis in enumerate("xyz")}
    listed |= {f"size_{axis}": size[k] for k, axis in enumerate("xyz")} | {"diameter": 140.5}
    models = {"8": {**listed, "symmetries_discrete": [[1] * 16]}, "5": listed, "11": listed}
    for number in models:
        write_ply(tmp_path / "models" / f"obj_{int(number):06d}.ply", 1000 * known.vertices)
    (tmp_path / "models" / "models_info.json").write_text(json.dumps(models))
    return Bop(path=tmp_path)


def test_all_scenes_of_a_split_are_read_in_order_and_in_meters(published, known, making):
    made = published.load(NAME, making)
    assert made.mapping.folder == published.path / "train_real"
    assert made.mapping.names == ("000001/rgb/000000.jpg", "000002/rgb/000002.png", "000002/rgb/000010.png")
    assert all(path.is_file() for path in (*made.mapping.image_paths, *made.query.image_paths))
    known.check(made.mapping, (0, 2, 10), [intrinsics(k) for k in (0, 2, 10)])
    assert made.unit == "metre"
    assert (made.mapping.cameras[0].width, made.mapping.cameras[0].height) == (80, 60)


def test_images_that_show_the_object_exactly_once_and_well_are_used(published, known, making):
    made = published.load(NAME, making)
    assert made.query.names == ("000002/rgb/000005.png",)
    known.check(made.query, (5,), [intrinsics(5)])


def test_without_visibility_all_images_that_show_it_once_are_used(published, making):
    (published.path / "test" / "000002" / "scene_gt_info.json").unlink()
    query = published.load(NAME, making).query
    assert query.names == ("000002/rgb/000004.png", "000002/rgb/000005.png")


def test_box_diameter_and_model_are_converted_to_meters(published, known, making):
    made = published.load(NAME, making)
    assert np.allclose(made.box.center, known.box.center)
    assert np.allclose(made.box.half_edges, known.box.half_edges)
    assert made.model.diameter == pytest.approx(0.1405)
    assert np.allclose(made.model.vertices, known.vertices)
    assert not made.model.symmetric


def test_objects_are_in_both_splits(published, making):
    assert published.names() == (NAME, "obj_000008")
    assert published.load("obj_000008", making).model.symmetric
    with pytest.raises(InputError, match="test: no image shows obj_000011"):
        replace(published, mapping_split="test", query_split="train_real").load("obj_000011", making)
    with pytest.raises(InputError, match="has no object 'obj_000001'; it has obj_000005, "):
        published.load("obj_000001", making)


def test_a_step_uses_every_nth_image(published, making):
    made = replace(published, frame_step=2).load(NAME, making)
    assert made.mapping.names == ("000001/rgb/000000.jpg", "000002/rgb/000010.png")


def test_gray_images_and_other_models_are_read(published, known, making, write_scene, write_ply):
    write_scene(published.path / "val" / "000000", {1: [OURS]}, names="gray/{:06d}.tif")
    write_ply(published.path / "models_eval" / f"{NAME}.ply", 990 * known.vertices)
    info = (published.path / "models" / "models_info.json").read_text()
    (published.path / "models_eval" / "models_info.json").write_text(info)
    made = replace(published, query_split="val", models="models_eval").load(NAME, making)
    assert made.query.names == ("000000/gray/000001.tif",)
    assert np.allclose(made.model.vertices, 0.99 * known.vertices)


def test_it_can_be_pickled(published):
    assert pickle.loads(pickle.dumps(published)) == published


GT, CAMERA, INFO = (
    "test/000002/scene_gt.json",
    "test/000002/scene_camera.json",
    "test/000002/scene_gt_info.json",
)
MODELS = "models/models_info.json"
DAMAGES = {
    "cut ground truth": (GT, "", "{", "cannot be read as JSON"),
    "ground truth of another kind": (GT, "", [], "must hold a JSON object, got a list"),
    "image without number": (GT, "x", [], "must have numeric keys, got 'x'"),
    "image of words": (GT, "5", "none", "image 5, must be a list, got a str"),
    "no object's number": (GT, "5/1/obj_id", None, "image 5, must have an obj_id"),
    "no rotation": (GT, "5/1/cam_R_m2c", [2, 0, 0, 0, 2, 0, 0, 0, 2], "image 5, is not a pose"),
    "short rotation": (GT, "5/1/cam_R_m2c", [1, 0], "image 5, must have cam_R_m2c: 9 numbers"),
    "translation of words": (GT, "5/1/cam_t_m2c", ["a", 0, 0], "image 5, must have cam_t_m2c: 3 numbers"),
    "translation not finite": (GT, "5/1/cam_t_m2c", [float("nan"), 0, 0], "cam_t_m2c: 3 finite numbers"),
    "no camera": (CAMERA, "5", None, "image 5, must have cam_K"),
    "short matrix": (CAMERA, "5/cam_K", [1, 2], "image 5, must have cam_K: 9 numbers"),
    "no focal length": (CAMERA, "5/cam_K", [0, 0, 1, 0, 1, 1, 0, 0, 1], "image 5, must have positive focal"),
    "no visibility": (INFO, "5", [], "image 5, must have a visib_fract"),
    "diameter in meters": (MODELS, "5/diameter", 0.14, "object 5, has a diameter .* check the unit"),
    "no extent": (MODELS, "5/size_x", None, "object 5, must have min_x"),
    "negative diameter": (MODELS, "5/diameter", -1, "object 5, must have .* positive"),
    "model of words": (MODELS, "5", "big", "object 5, must be a dict, got a str"),
}  # fmt: skip


@pytest.mark.parametrize(("path", "place", "value", "message"), DAMAGES.values(), ids=DAMAGES.keys())
def test_a_wrong_entry_is_named_in_the_error(published, making, path, place, value, message):
    file = published.path / path
    data = json.loads(file.read_text())
    *way, last = [int(key) if key in ("0", "1") else key for key in place.split("/")]
    parent = data
    for key in way:
        parent = parent[key]
    if not place:
        data = value
    elif value is None:
        del parent[last]
    else:
        parent[last] = value
    file.write_text(value if value == "{" else json.dumps(data))
    with pytest.raises(InputError, match=message) as error:
        published.load(NAME, making)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        (GT, None, "there is no such file"),
        (CAMERA, None, "there is no such file"),
        (MODELS, None, "there is no such file"),
        ("test/000002/rgb/000005.png", None, "cannot be read as an image: there is no such file"),
        ("train_real/000001/rgb/000000.jpg", b"\xff\xd8\xff", "cannot be read as an image"),
        (f"models/{NAME}.ply", None, "there is no such file"),
        (f"models/{NAME}.ply", "text", "cannot be read as a PLY file"),
    ],
)
def test_a_missing_or_damaged_file_is_named_in_the_error(published, making, damage, path, content, message):
    damage(published.path / path, content)
    with pytest.raises(InputError, match=message) as error:
        published.load(NAME, making)
    assert str(published.path / path) in str(error.value)


def test_a_model_in_meters_is_an_error(published, known, making, write_ply):
    write_ply(published.path / "models" / f"{NAME}.ply", known.vertices)
    with pytest.raises(InputError, match=rf"{NAME}\.ply, in millimeters, is 0\.001.* times .*check the unit"):
        published.load(NAME, making)


def test_missing_or_empty_splits_are_named_in_the_error(published, making):
    with pytest.raises(
        InputError, match="train is not a folder: choose a split from models, test, train_real"
    ):
        replace(published, mapping_split="train").names()
    (published.path / "val").mkdir()
    with pytest.raises(InputError, match="val holds no scene"):
        replace(published, query_split="val").load(NAME, making)
    with pytest.raises(ValueError, match="query_split must differ from mapping_split, got 'test'"):
        Bop(path=published.path, mapping_split="test")
    with pytest.raises(ValueError, match="frame_step must be at least 1, got 0"):
        Bop(path=published.path, frame_step=0)


def test_splits_without_a_common_object_are_an_error(published):
    (published.path / "test" / "000002" / "scene_gt.json").write_text('{"1": [{"obj_id": 11}]}')
    with pytest.raises(
        InputError, match=r"no object of models/models_info\.json is in both train_real and test"
    ):
        published.names()
