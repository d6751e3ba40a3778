import pickle

import pytest

torch = pytest.importorskip("torch")

from torch import nn  # noqa: E402

from slimsfm.errors import InputError  # noqa: E402
from slimsfm.networks import loading  # noqa: E402
from slimsfm.networks.devices import choose_device
from slimsfm.networks.loading import load_network, load_state  # noqa: E402
from slimsfm.weights import (
    DEVICE,
    FOLDER,
)


class Explosive:
    """Does harm when it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("code in a file of weights was run",))


def network(width: int = 3) -> nn.Module:
    return nn.Linear(width, 2)


def values_of(module: nn.Module) -> list:
    return [value.clone() for value in module.state_dict().values()]


def equal(one: list, other: list) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_what_was_saved_is_loaded(tmp_path):
    saved, loaded = network(), network()
    torch.save(saved.state_dict(), tmp_path / "w.pth")
    load_state(loaded, tmp_path / "w.pth")
    assert equal(values_of(saved), values_of(loaded))


def test_checkpoints_of_training_frameworks_are_read_without_running_their_code(tmp_path):
    saved, loaded = network(), network()
    checkpoint = {"state_dict": saved.state_dict(), "hyper_parameters": {"anything": Explosive()}, "epoch": 3}
    torch.save(checkpoint, tmp_path / "w.ckpt")
    load_state(loaded, tmp_path / "w.ckpt", lambda held: dict(held["state_dict"]))
    assert equal(values_of(saved), values_of(loaded))


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"weight": torch.zeros(2, 3)}, "bias is missing"),
        (
            {"weight": torch.zeros(2, 4), "bias": torch.zeros(2)},
            r"weight has shape \(2, 4\) instead of \(2, 3\)",
        ),
        (
            {"weight": torch.zeros(2, 3), "bias": torch.zeros(2), "more": torch.zeros(1)},
            "more is not one of its values",
        ),
    ],
    ids=["missing", "shape", "surplus"],
)
def test_weights_of_another_network_are_told_and_never_half_loaded(tmp_path, state, message):
    untouched = network()
    before = values_of(untouched)
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(InputError, match=rf"w\.pth: these are not the weights of Linear: {message}"):
        load_state(untouched, tmp_path / "w.pth")
    assert equal(before, values_of(untouched))


def test_a_layout_that_nobody_knows_is_told(tmp_path):
    torch.save(network().state_dict(), tmp_path / "w.pth")
    with pytest.raises(InputError, match=r"w\.pth: these are not the weights of Linear"):
        load_state(network(), tmp_path / "w.pth", lambda held: dict(held["state_dict"]))


@pytest.mark.parametrize("content", [b"", b"not a file of weights", pickle.dumps(Explosive())])
@pytest.mark.parametrize("name", ["w.pth", "w.safetensors"])
def test_damaged_files_are_told(tmp_path, content, name):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        load_state(network(), tmp_path / name)


def test_values_that_a_network_derives_may_be_missing(tmp_path):
    torch.save({"weight": torch.ones(2, 3)}, tmp_path / "w.pth")
    made = network()
    load_state(made, tmp_path / "w.pth", derived={"bias"})
    assert torch.equal(made.state_dict()["weight"], torch.ones(2, 3))


def test_missing_weights_are_named_where_there_is_no_network(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    monkeypatch.setattr(loading, "_from_hugging_face", lambda _address: None)
    with pytest.raises(InputError, match=r"weights depth-save\.pth are missing; get them from the DISK"):
        load_network(network(), "disk")


def test_what_the_hub_gives_is_loaded(monkeypatch, tmp_path):
    monkeypatch.delenv(FOLDER, raising=False)
    saved = network()
    torch.save(saved.state_dict(), tmp_path / "depth-save.pth")
    monkeypatch.setattr(loading, "_from_hugging_face", lambda _address: tmp_path / "depth-save.pth")
    assert equal(values_of(load_network(network(), "disk")), values_of(saved))


def test_the_device_is_as_wished(monkeypatch):
    monkeypatch.setenv(DEVICE, "cpu")
    assert choose_device().type == "cpu"
    monkeypatch.setenv(DEVICE, "abacus")
    with pytest.raises(InputError, match="device must be auto, cpu or cuda, got 'abacus'"):
        choose_device()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_told():
    with pytest.raises(InputError, match="torch sees no GPU here; use --device cpu"):
        choose_device("cuda")
