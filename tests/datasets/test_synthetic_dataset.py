import pickle
from dataclasses import replace

import numpy as np
import pytest

from slimsfm.datasets.onepose import read_object
from slimsfm.datasets.synthetic import Synthetic
from slimsfm.errors import InputError
from slimsfm.synthetic.objects import OBJECTS


def test_a_missing_object_is_rendered(rendered):
    dataset, made = rendered
    read = read_object(dataset.path / "printed_box")
    assert (len(made.mapping.names), len(made.query.names)) == (16, 2)
    assert made.mapping.image_paths == read.mapping.image_paths
    for ours, theirs in zip(made.query.cam_from_world, read.query.cam_from_world, strict=True):
        assert np.array_equal(ours.matrix(), theirs.matrix())
    assert (made.unit, made.model, made.truth) == ("metre", None, None)


def test_an_existing_object_is_read(rendered, making):
    dataset, made = rendered
    before = {path: path.stat().st_mtime_ns for path in dataset.path.rglob("*")}
    again = Synthetic(path=dataset.path, objects=("printed_box",), render_seed=3).load("printed_box", making)
    assert again.mapping.names == made.mapping.names
    assert {path: path.stat().st_mtime_ns for path in dataset.path.rglob("*")} == before


@pytest.mark.parametrize(
    ("field", "there"), [("mapping_frames", 16), ("query_frames", 2), ("width", 320), ("height", 240)]
)
def test_an_existing_object_must_match_the_options(rendered, making, field, there):
    dataset = rendered[0]
    with pytest.raises(InputError, match=f"was rendered with {field} {there}, not 99") as error:
        replace(dataset, **{field: 99}).load("printed_box", making)
    assert str(dataset.path / "printed_box") in str(error.value)


def test_damaged_files_are_named_in_the_error(tmp_path, making):
    (tmp_path / "can").mkdir()
    with pytest.raises(InputError, match=r"can/box3d_corners\.txt: .*no such file"):
        Synthetic(path=tmp_path).load("can", making)


def test_objects_are_sorted(tmp_path, making):
    assert Synthetic(path=tmp_path).names() == tuple(sorted(OBJECTS))
    dataset = Synthetic(path=tmp_path, objects=("printed_box", "can"))
    assert dataset.names() == ("can", "printed_box")
    with pytest.raises(InputError, match="has no object 'ball'; it has can, printed_box"):
        dataset.load("ball", making)


@pytest.mark.parametrize(
    "values",
    [{"objects": ("teapot",)}, {"objects": ()}, {"mapping_frames": 0}, {"height": -1}, {"render_seed": -1}],
    ids=str,
)
def test_invalid_options_are_named_in_the_error(tmp_path, values):
    with pytest.raises(ValueError, match=next(iter(values)).removeprefix("render_")):
        Synthetic(path=tmp_path, **values)


def test_it_can_be_pickled(rendered):
    assert pickle.loads(pickle.dumps(rendered[0])) == rendered[0]
