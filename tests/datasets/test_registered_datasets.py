import pickle
from dataclasses import FrozenInstanceError, fields
from pathlib import Path

import pytest

from slimsfm.datasets import DATASETS
from slimsfm.datasets.base import Dataset


@pytest.fixture(params=DATASETS)
def dataset(request, tmp_path):
    kind = DATASETS[request.param]
    asked = {"images": tmp_path} if request.param == "colmap" else {}
    return kind(path=tmp_path, **asked)


def test_every_data_set_has_a_path_and_is_immutable(dataset, tmp_path):
    assert isinstance(dataset, Dataset)
    assert fields(dataset)[0].name == "path"
    assert dataset.path == tmp_path
    with pytest.raises(FrozenInstanceError):
        dataset.path = Path("elsewhere")


def test_every_data_set_can_be_pickled(dataset):
    assert pickle.loads(pickle.dumps(dataset)) == dataset
    assert hash(dataset) == hash(pickle.loads(pickle.dumps(dataset)))


@pytest.mark.parametrize("kind", DATASETS.values(), ids=DATASETS.keys())
def test_options_are_given_by_name(kind):
    with pytest.raises(TypeError, match="positional"):
        kind(Path())
