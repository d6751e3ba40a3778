import codecs
import os
import shutil
import struct

import numpy as np
import pycolmap
import pytest

from commands import state
from scenes import exact_map
from slimsfm.errors import ModelError
from slimsfm.mapping.model import read_model

PARTS = ("cameras", "frames", "images", "points3D", "rigs")


def small_model():
    return exact_map(3, 5).model


def rig_model():
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=3, num_frames_per_rig=2, num_points3D=6
    )
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(options)


MODELS = {"single": small_model, "rig": rig_model}


def contents(model):
    """All content of a model, for comparison."""
    return {
        "cameras": {i: (c.model_name, c.width, c.height, *c.params) for i, c in model.cameras.items()},
        "rigs": {i: sorted(str(s) for s in r.sensor_ids()) for i, r in model.rigs.items()},
        "images": {
            i: (
                image.name,
                image.camera_id,
                image.cam_from_world().matrix().tolist(),
                [(*p.xy, p.point3D_id) for p in image.points2D],
            )
            for i, image in model.images.items()
        },
        "points": {
            i: (*p.xyz, *p.color, p.error, sorted((e.image_id, e.point2D_idx) for e in p.track.elements))
            for i, p in model.points3D.items()
        },
    }


@pytest.fixture
def text(tmp_path):
    """A small model as text, to be damaged."""
    small_model().write_text(tmp_path)
    return tmp_path


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS.keys())
def test_binary_and_text_models_are_read_equal(tmp_path, make):
    model = make()
    for kind in ("binary", "text"):
        (tmp_path / kind).mkdir()
        getattr(model, f"write_{kind}")(tmp_path / kind)
    binary, text = (contents(read_model(tmp_path / kind)) for kind in ("binary", "text"))
    assert binary == contents(model)
    for part in ("cameras", "rigs", "points"):
        assert text[part] == binary[part]
    for image_id, (name, camera_id, pose, points2D) in text["images"].items():
        assert (name, camera_id, points2D) == (
            binary["images"][image_id][0],
            binary["images"][image_id][1],
            points2D,
        )
        assert np.array(pose) == pytest.approx(np.array(binary["images"][image_id][2]), abs=1e-12)
        assert points2D == binary["images"][image_id][3]


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_models_from_before_rigs_and_frames_are_read(tmp_path, kind):
    model = small_model()
    getattr(model, f"write_{kind}")(tmp_path)
    for path in [*tmp_path.glob("rigs.*"), *tmp_path.glob("frames.*")]:
        path.unlink()
    assert len(list(tmp_path.iterdir())) == 3
    read, expected = contents(read_model(tmp_path)), contents(model)
    assert read["cameras"] == expected["cameras"]
    assert read["points"] == expected["points"]
    for image_id, (name, camera_id, pose, points2D) in read["images"].items():
        assert (name, camera_id, points2D) == (*expected["images"][image_id][:2], points2D)
        assert np.array(pose) == pytest.approx(np.array(expected["images"][image_id][2]), abs=1e-12)


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_names_may_contain_spaces_and_folders(tmp_path, kind):
    model = small_model()
    names = {1: "take 1/frame  1.png", 2: "take 1/frame 2.png", 3: "ä ö.png"}
    for image_id, name in names.items():
        model.image(image_id).name = name
    getattr(model, f"write_{kind}")(tmp_path)
    assert {i: image.name for i, image in read_model(tmp_path).images.items()} == names


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS.keys())
@pytest.mark.parametrize("part", PARTS)
def test_a_binary_file_of_any_wrong_length_is_a_model_error(tmp_path, make, part):
    make().write_binary(tmp_path)
    path = tmp_path / f"{part}.bin"
    whole = path.read_bytes()
    for length in range(0, len(whole), max(1, len(whole) // 120)):
        path.write_bytes(whole[:length])
        with pytest.raises(ModelError, match=part):
            read_model(tmp_path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(ModelError, match="too long"):
        read_model(tmp_path)


def outcome(folder):
    """Read a model and all of its content in a child process, which may crash."""
    child = os.fork()
    if child == 0:
        code = 2
        try:
            contents(read_model(folder))
            code = 0
        except ModelError:
            code = 1
        finally:
            os._exit(code)
    return os.waitpid(child, 0)[1]


@pytest.mark.parametrize("part", PARTS)
def test_a_wrong_byte_never_crashes(tmp_path, part):
    whole_folder, folder = tmp_path / "whole", tmp_path / "damaged"
    whole_folder.mkdir()
    small_model().write_binary(whole_folder)
    shutil.copytree(whole_folder, folder)
    whole = (whole_folder / f"{part}.bin").read_bytes()
    rng = np.random.default_rng(0)
    outcomes = set()
    for position in rng.integers(0, min(len(whole), 400), 25):
        damaged = bytearray(whole)
        damaged[position] ^= int(rng.integers(1, 256))
        (folder / f"{part}.bin").write_bytes(damaged)
        outcomes.add(outcome(folder))
    assert outcomes <= {0, 1 << 8}


def lines_of(folder, part):
    return (folder / f"{part}.txt").read_text().split("\n")


def first_record(lines):
    return next(i for i, line in enumerate(lines) if line and not line.startswith("#"))


def cut(line):
    return " ".join(line.split(" ")[:-1])


TEXT_DAMAGES = {
    "word": lambda line: "word " + line.split(" ", 1)[1],
    "cut": cut,
    "gone": lambda _: None,
    "empty": lambda _: "",
    "twice": lambda line: f"{line}\n{line}",
}


@pytest.mark.parametrize("damage", TEXT_DAMAGES.values(), ids=TEXT_DAMAGES.keys())
@pytest.mark.parametrize("part", PARTS)
def test_damaged_text_is_a_model_error(text, part, damage):
    lines = lines_of(text, part)
    row = first_record(lines)
    lines[row] = damage(lines[row])
    (text / f"{part}.txt").write_text("\n".join(line for line in lines if line is not None))
    if part == "images" and damage is cut:  # the name was the last word; what remains reads as another name
        assert outcome(text) in (0, 1 << 8)
    else:
        with pytest.raises(ModelError, match=str(text)):
            read_model(text)


def replace_word(folder, part, word, value, row=0):
    lines = lines_of(folder, part)
    record = first_record(lines) + row
    words = lines[record].split(" ")
    words[word] = value
    lines[record] = " ".join(words)
    (folder / f"{part}.txt").write_text("\n".join(lines))


WRONG_WORDS = {
    "a track in an image that is not there": ("points3D", 8, "77"),
    "a track at a keypoint that is not there": ("points3D", 9, "7700"),
    "a track at the keypoint of another point": ("points3D", 9, "3"),
    "an image of a camera that is not there": ("images", 8, "9"),
    "a keypoint of a point that is not there": ("images", 2, "500", 1),
    "a frame of a rig that is not there": ("frames", 1, "9"),
    "a pose that is no number": ("frames", 6, "nan"),
    "a point that is no number": ("points3D", 2, "nan"),
    "a focal length of zero": ("cameras", 4, "0"),
    "a negative focal length": ("cameras", 4, "-500"),
    "a focal length of 1e300": ("cameras", 4, "1e300"),
    "distortion of 1e9": ("cameras", slice(8, 12), ["1e9"] * 4),
    "a principal point of 1e5": ("cameras", 6, "1e5"),
    "a camera at 1e200": ("frames", 6, "1e200"),
    "a point at 1e200": ("points3D", 1, "-1e200"),
    "a width of zero": ("cameras", 2, "0"),
    "a negative width": ("cameras", 2, "-640"),
    "two images of a name": ("images", 9, "002.png"),
}


@pytest.mark.parametrize("wrong", WRONG_WORDS.values(), ids=WRONG_WORDS.keys())
def test_a_model_of_inconsistent_parts_is_a_model_error(text, wrong):
    replace_word(text, *wrong)
    with pytest.raises(ModelError, match=str(text)):
        read_model(text)


def test_a_track_without_an_observation_that_its_image_has_is_a_model_error(text):
    lines = lines_of(text, "points3D")
    row = first_record(lines)
    lines[row] = " ".join(lines[row].split(" ")[:-2])
    (text / "points3D.txt").write_text("\n".join(lines))
    with pytest.raises(ModelError, match="do not belong together"):
        read_model(text)


def test_points_and_poses_that_are_not_finite_are_a_model_error(tmp_path):
    model = small_model()
    model.point3D(1).xyz = np.array([0.0, np.nan, 0.0])
    model.write_binary(tmp_path)
    with pytest.raises(ModelError, match="not finite"):
        read_model(tmp_path)


def test_points_in_one_place_are_a_model_error(tmp_path):
    model = small_model()
    for point in model.points3D.values():
        point.xyz = np.array([7.0, -3.0, 1e-15])
    model.write_binary(tmp_path)
    with pytest.raises(ModelError, match="its 5 points are all in one place"):
        read_model(tmp_path)


def test_a_name_that_is_not_unicode_is_a_model_error(tmp_path):
    small_model().write_binary(tmp_path)
    path = tmp_path / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"001.png", b"\xff01.png"))
    with pytest.raises(ModelError, match="cannot read"):
        read_model(tmp_path)


def test_a_spherical_camera_is_a_model_error(text):
    replace_word(text, "cameras", slice(1, None), ["EQUIRECTANGULAR", "640", "480", "640", "480"])
    with pytest.raises(ModelError, match=r"spherical.*cut its images into perspective ones") as error:
        read_model(text)
    assert "export the model again" not in str(error.value)


@pytest.mark.parametrize("parts", [*((part,) for part in PARTS), PARTS])
def test_a_byte_order_mark_changes_nothing(text, parts):
    expected = contents(read_model(text))
    for part in parts:
        path = text / f"{part}.txt"
        path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())
    before = state(text)
    assert contents(read_model(text)) == expected
    assert state(text) == before


QUATERNIONS = {"binary": ("frames.bin", 16), "old binary": ("images.bin", 12)}  # file, position of the first


@pytest.mark.parametrize("form", QUATERNIONS)
@pytest.mark.parametrize("length", [0.0, 1e-12, np.nan, 0.3, 1.0001, 7.0])
def test_quaternions_may_have_any_length_but_zero(tmp_path, form, length):
    model = small_model()
    model.write_binary(tmp_path)
    if form == "old binary":
        for name in ("rigs.bin", "frames.bin"):
            (tmp_path / name).unlink()
    name, position = QUATERNIONS[form]
    data = bytearray((tmp_path / name).read_bytes())
    quaternion = length * np.array(struct.unpack_from("<4d", data, position))
    struct.pack_into("<4d", data, position, *quaternion)
    (tmp_path / name).write_bytes(data)
    if length > 1e-9:
        poses = [one.image(1).cam_from_world().matrix() for one in (read_model(tmp_path), model)]
        assert poses[0] == pytest.approx(poses[1], abs=1e-12)
    else:
        with pytest.raises(ModelError, match="export the model again"):
            read_model(tmp_path)


@pytest.mark.parametrize("word", ["nan", "-nan", "NaN", "inf", "-inf", "Infinity"])
def test_keypoints_of_text_models_may_be_no_number(text, word):
    expected = contents(read_model(text))["images"][1]
    replace_word(text, "images", 3, word, row=1)
    replace_word(text, "images", 9, "nan inf.png")
    name, _, _, points2D = contents(read_model(text))["images"][1]
    assert name == "nan inf.png"
    assert np.isnan(points2D[1][0])
    assert points2D[1][1:] == expected[3][1][1:]
    assert points2D[0] == expected[3][0]
    assert points2D[2:] == expected[3][2:]


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_a_missing_file_is_named(tmp_path, part, suffix):
    (small_model().write_binary if suffix == "bin" else small_model().write_text)(tmp_path)
    (tmp_path / f"{part}.{suffix}").unlink()
    with pytest.raises(ModelError, match=part):
        read_model(tmp_path)


def test_a_folder_without_a_model_and_a_model_without_poses_are_model_errors(tmp_path):
    with pytest.raises(ModelError, match="no COLMAP model here"):
        read_model(tmp_path / "missing")
    pycolmap.Reconstruction().write_binary(tmp_path)
    with pytest.raises(ModelError, match="no image with a pose"):
        read_model(tmp_path)
