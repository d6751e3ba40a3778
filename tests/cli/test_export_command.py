import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("transformers")
pytest.importorskip("onnxscript")

from transformers import SuperPointConfig, SuperPointForKeypointDetection  # noqa: E402

from commands import contents, slimsfm  # noqa: E402
from networks.seeded import fill  # noqa: E402
from slimsfm.features.registry import EXPORTABLE  # noqa: E402
from slimsfm.weight_files import WEIGHTS  # noqa: E402
from slimsfm.weights import FOLDER  # noqa: E402


@pytest.fixture
def weights(tmp_path, monkeypatch):
    monkeypatch.delenv(FOLDER, raising=False)
    network = SuperPointForKeypointDetection(SuperPointConfig())
    fill(network, 0)
    folder = tmp_path / "weights"
    folder.mkdir()
    torch.save(network.state_dict(), folder / "superpoint_v1.pth")
    monkeypatch.setenv(FOLDER, str(folder))  # restores what --weights sets for the process
    return folder


def test_a_file_is_written_and_its_use_explained(weights):
    path = weights / "superpoint.onnx"
    outcome = slimsfm("export", "onnx", "superpoint", "-o", path, "--weights", weights)
    assert outcome.code == 0, outcome.err
    assert f"{path}: superpoint, " in outcome.out
    assert "put it into the folder of weights as superpoint.onnx" in outcome.out
    assert sorted(contents(weights)) == ["superpoint.onnx", "superpoint_v1.pth"]
    again = slimsfm("export", "onnx", "superpoint", "-o", path)
    assert again.code == 2
    assert "pass --overwrite" in again.err


@pytest.mark.parametrize("method", ["superglue", "onepose", "nonsense"])
def test_a_method_that_cannot_be_exported_is_answered_by_those_that_can(tmp_path, method):
    outcome = slimsfm("export", "onnx", method, "-o", tmp_path / "x.onnx")
    assert outcome.code == 2
    assert len(outcome.err.splitlines()) == 1
    assert f"'{method}' cannot be exported" in outcome.err
    assert all(name in outcome.err for name in EXPORTABLE)
    assert contents(tmp_path) == {}


def test_a_folder_is_not_replaced_by_a_file(weights):
    before = contents(weights)
    outcome = slimsfm("export", "onnx", "superpoint", "-o", weights, "--overwrite")
    assert outcome.code == 2
    assert "superpoint.onnx" in outcome.err
    assert contents(weights) == before


def test_methods_have_the_names_of_their_weights():
    assert EXPORTABLE.keys() < WEIGHTS.keys()
