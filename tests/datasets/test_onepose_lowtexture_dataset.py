import pickle

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from slimsfm.datasets.onepose import OnePoseLowTexture
from slimsfm.errors import InputError

NAME = "0700-toyrobot-others"
CROPS = [np.array([[900.0, 0, 250.0 - k], [0, 910.0, 260.0], [0, 0, 1]]) for k in range(3)]


@pytest.fixture
def published(tmp_path, known, write_onepose, write_ply):
    """Two objects as they are published, one with its scanned model."""
    root = tmp_path / "lowtexture_test_data"
    for name in (NAME, "0701-yellowduck-others"):
        write_onepose(root / name, known, 3, CROPS, sequences=("toyrobot-1", "toyrobot-2"))
    write_ply(root / NAME / "model_eval.ply", known.vertices, "binary")
    (root / NAME / "diameter.txt").write_text("0.14\n")
    return OnePoseLowTexture(path=root, frame_step=2)


def test_crops_are_read_as_published(published, known, making):
    assert published.names() == (NAME, "0701-yellowduck-others")
    made = published.load(NAME, making)
    assert made.mapping.folder == published.path / NAME / "toyrobot-1" / "color"
    known.check(made.mapping, (0, 2), CROPS[::2])
    known.check(made.query, (0, 2), CROPS[::2])
    assert made.unit == "metre"
    assert len(OnePoseLowTexture(path=published.path).load(NAME, making).mapping.names) == 1


def test_a_scanned_object_has_a_model(published, known, making):
    model = published.load(NAME, making).model
    assert np.allclose(model.vertices, known.vertices, atol=1e-7)
    assert (model.diameter, model.symmetric) == (0.14, False)
    assert published.load("0701-yellowduck-others", making).model is None


def test_a_missing_diameter_is_computed(published, known, making):
    (published.path / NAME / "diameter.txt").unlink()
    assert published.load(NAME, making).model.diameter == pytest.approx(pdist(known.vertices).max())


def test_the_model_for_evaluation_has_priority(published, known, making, write_ply):
    write_ply(published.path / NAME / "model.ply", 0.9 * known.vertices)
    assert np.allclose(published.load(NAME, making).model.vertices, known.vertices, atol=1e-7)
    (published.path / NAME / "model_eval.ply").unlink()
    assert np.allclose(published.load(NAME, making).model.vertices, 0.9 * known.vertices, atol=1e-7)


def test_it_can_be_pickled(published):
    assert pickle.loads(pickle.dumps(published)) == published


CUT = b"ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
ENDLESS = CUT + b"property float z\nend_header\n0 0 0\n"
DAMAGES = {
    "no box": ("box3d_corners.txt", None, "no such file"),
    "no ply": ("model_eval.ply", b"solid model", "cannot be read as a PLY file"),
    "cut header": ("model_eval.ply", CUT, "cannot be read as a PLY file"),
    "cut vertices": ("model_eval.ply", ENDLESS, "PLY file|four finite vertices"),
    "not finite": ("model_eval.ply", ENDLESS.replace(b"9", b"1").replace(b"0 0 0", b"0 0 nan"), "finite"),
    "diameter of words": ("diameter.txt", "long", "1 rows of 1"),
    "two diameters": ("diameter.txt", "0.1 0.2", "1 rows of 1"),
    "diameter in millimeters": ("diameter.txt", "140", "check the unit"),
    "no pose": ("toyrobot-2/poses_ba/1.txt", None, "1.png has no pose"),
    "damaged matrix": ("toyrobot-2/intrin_ba/2.txt", "1 0 0\n", "3 rows of 3"),
}


@pytest.mark.parametrize(("path", "content", "message"), DAMAGES.values(), ids=DAMAGES.keys())
def test_a_wrong_file_is_named_in_the_error(published, making, damage, path, content, message):
    damage(published.path / NAME / path, content)
    with pytest.raises(InputError, match=message) as error:
        published.load(NAME, making)
    named = path.replace("poses_ba/1.txt", "color/1.png") if content is None else path
    assert str(published.path / NAME / named) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_truncated_binary_model_is_an_error(published, making, damage):
    path = published.path / NAME / "model_eval.ply"
    damage(path, path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"model_eval\.ply"):
        published.load(NAME, making)


def test_a_model_in_millimeters_is_an_error(published, known, making, write_ply):
    write_ply(published.path / NAME / "model_eval.ply", 1000 * known.vertices)
    with pytest.raises(
        InputError, match=r"model_eval\.ply, in meters, is .* times as large .*check the unit"
    ):
        published.load(NAME, making)


def test_an_invalid_step_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="frame_step must be at least 1, got -1"):
        OnePoseLowTexture(path=tmp_path, frame_step=-1)
