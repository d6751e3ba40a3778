import pickle

import numpy as np
import pytest

from slimsfm.datasets.linemod import Linemod
from slimsfm.errors import InputError

INTRINSICS = np.array([[572.4114, 0, 325.2611], [0, 573.57043, 242.04899], [0, 0, 1]])
NUMBERS = {"ape": 1, "eggbox": 10}


@pytest.fixture
def published(tmp_path, known, write_image, write_ply):
    """Two objects in CDPN's layout; image k shows pose k."""
    low, size = 1000 * known.box.corners.min(axis=0), 1000 * np.ptp(known.box.corners, axis=0)
    lines = []
    for name, number in NUMBERS.items():
        for split, images in (("real_train", (2, 10, 4)), ("real_test", (1, 3))):
            folder = tmp_path / split / name
            for image in images:
                write_image(folder / f"{image:06d}-color.png", 640, 480)
                write_image(folder / f"{image:06d}-label.png", 640, 480)
                np.savetxt(folder / f"{image:06d}-pose.txt", known.poses[image].matrix())
                (folder / f"{image:06d}-box.txt").write_text("1 2 3 4")
        write_ply(tmp_path / "models" / name / f"{name}.ply", known.vertices)
        words = [
            f"{kind}_{axis} {values[k]:.6f}"
            for kind, values in (("min", low), ("size", size))
            for k, axis in enumerate("xyz")
        ]
        lines.append(f"{number} diameter 140.5 {' '.join(words)}")
    (tmp_path / "models" / "models_info.txt").write_text("\n".join(lines) + "\n")
    return Linemod(path=tmp_path)


def test_real_images_are_read_in_meters(published, known, making):
    assert published.names() == ("ape", "eggbox")
    made = published.load("ape", making)
    assert made.mapping.folder == published.path / "real_train" / "ape"
    assert made.mapping.names == ("000002-color.png", "000004-color.png", "000010-color.png")
    assert made.query.names == ("000001-color.png", "000003-color.png")
    known.check(made.mapping, (2, 4, 10), [INTRINSICS] * 3)
    known.check(made.query, (1, 3), [INTRINSICS] * 2)
    assert made.unit == "metre"
    assert (made.query.cameras[0].width, made.query.cameras[0].height) == (640, 480)


def test_box_diameter_and_model_are_converted_to_meters(published, known, making):
    made = published.load("ape", making)
    assert np.allclose(made.box.center, known.box.center)
    assert np.allclose(made.box.half_edges, known.box.half_edges)
    assert made.model.diameter == pytest.approx(0.1405)
    assert np.allclose(made.model.vertices, known.vertices)


def test_eggbox_and_glue_are_symmetric(published, making):
    assert published.load("eggbox", making).model.symmetric
    assert not published.load("ape", making).model.symmetric


def test_poses_with_four_rows_are_read(published, known, making):
    for path in (published.path / "real_train" / "ape").glob("*-pose.txt"):
        np.savetxt(path, known.matrix(int(path.name[:6])))
    known.check(published.load("ape", making).mapping, (2, 4, 10), [INTRINSICS] * 3)


def test_it_can_be_pickled(published):
    assert pickle.loads(pickle.dumps(published)) == published


APE = "1 diameter 140.5 min_x -1 min_y -1 min_z -1 size_x {} size_y 60 size_z 100\n"
MILLIMETERS = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "end_header\n0 0 0\n80 0 0\n0 60 0\n0 0 100\n"
)
DAMAGES = {
    "no pose": ("real_train/ape/000004-pose.txt", None, "000004-color.png has no pose"),
    "no image": ("real_test/ape/000003-color.png", None, "000003-pose.txt has no frame"),
    "pose of words": ("real_train/ape/000002-pose.txt", "a b c d\n" * 3, "3 or 4 rows of 4"),
    "short pose": ("real_test/ape/000001-pose.txt", "1 0 0 0\n0 1 0 0\n", "3 or 4 rows of 4"),
    "pose not finite": ("real_test/ape/000001-pose.txt", "1 0 0 inf\n0 1 0 0\n0 0 1 0\n", "finite"),
    "no rotation": ("real_test/ape/000001-pose.txt", "1 0 0 0\n0 1 0 0\n0 0 2 0\n", "rotation"),
    "no image file": ("real_train/ape/000010-color.png", "text", "cannot be read as an image"),
    "no list of models": ("models/models_info.txt", None, "there is no such file"),
    "not listed": ("models/models_info.txt", APE.format(1).replace("1 d", "2 d", 1), "one line for object 1"),
    "no size": ("models/models_info.txt", APE.replace("size_x {}", ""), "must have min_x"),
    "size of words": ("models/models_info.txt", APE.format("long"), "must have min_x"),
    "flat": ("models/models_info.txt", APE.format(0), "positive size"),
    "model in millimeters": ("models/ape/ape.ply", MILLIMETERS, "in meters, is .*check the unit"),
    "no model": ("models/ape/ape.ply", None, "there is no such file"),
    "no ply": ("models/ape/ape.ply", "text", "cannot be read as a PLY file"),
}  # fmt: skip


@pytest.mark.parametrize(("path", "content", "message"), DAMAGES.values(), ids=DAMAGES.keys())
def test_a_wrong_file_is_named_in_the_error(published, making, damage, path, content, message):
    damage(published.path / path, content)
    with pytest.raises(InputError, match=message) as error:
        published.load("ape", making)
    number = path.partition("-")[0]  # of a frame or pose that is missing its partner is named
    assert str(published.path / number) in str(error.value)
    assert "\n" not in str(error.value)


def test_images_of_another_size_are_an_error(published, making, write_image):
    for path in (published.path / "real_test" / "ape").glob("*-color.png"):
        write_image(path, 320, 240)
    with pytest.raises(InputError, match=r"000001-color\.png has 320x240 pixels, but LINEMOD's .* 640x480"):
        published.load("ape", making)


def test_objects_that_linemod_does_not_have_are_an_error(published, making):
    with pytest.raises(InputError, match="has no object 'duck'; it has ape, eggbox"):
        published.load("duck", making)
    (published.path / "real_train" / "teapot").mkdir()
    with pytest.raises(InputError, match="teapot does not have the name of a LINEMOD object"):
        published.names()


def test_a_folder_without_linemod_is_an_error(tmp_path):
    with pytest.raises(InputError, match="real_train is not a folder"):
        Linemod(path=tmp_path).names()
    (tmp_path / "real_train").mkdir()
    with pytest.raises(InputError, match="real_train holds no folder"):
        Linemod(path=tmp_path).names()
