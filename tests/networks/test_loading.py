import pickle

import pytest

torch = pytest.importorskip("torch")

from torch import nn  # noqa: E402

from slimsfm.errors import InputError  # noqa: E402
from slimsfm.networks.loading import (  # noqa: E402
    choose_device,
    load_network,
    load_state,
)
from slimsfm.weights import DEVICE, FOLDER, Runtime, use_runtime  # noqa: E402


class Explosive:
    """Fails the test when it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("code in a weight file was run",))


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
def test_weights_of_another_network_are_refused_and_never_half_loaded(tmp_path, state, message):
    untouched = network()
    before = values_of(untouched)
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(InputError, match=rf"w\.pth: these are not the weights of Linear: {message}"):
        load_state(untouched, tmp_path / "w.pth")
    assert equal(before, values_of(untouched))


def test_an_unknown_layout_is_refused(tmp_path):
    torch.save(network().state_dict(), tmp_path / "w.pth")
    with pytest.raises(InputError, match=r"w\.pth: these are not the weights of Linear"):
        load_state(network(), tmp_path / "w.pth", lambda held: dict(held["state_dict"]))


@pytest.mark.parametrize("content", [b"", b"not a file of weights", pickle.dumps(Explosive())])
@pytest.mark.parametrize("name", ["w.pth", "w.safetensors"])
def test_damaged_files_are_refused(tmp_path, content, name):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        load_state(network(), tmp_path / name)


def test_values_that_a_network_derives_may_be_missing(tmp_path):
    torch.save({"weight": torch.ones(2, 3)}, tmp_path / "w.pth")
    made = network()
    load_state(made, tmp_path / "w.pth", derived={"bias"})
    assert torch.equal(made.state_dict()["weight"], torch.ones(2, 3))


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """An empty cache of Hugging Face, and no network."""
    hub, constants = (pytest.importorskip(f"huggingface_hub{part}") for part in ("", ".constants"))
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(constants, "ENDPOINT", "https://nowhere.invalid")
    return hub


@pytest.mark.usefixtures("hub")
def test_missing_weights_are_named_without_a_network(tmp_path):
    message = r"weights depth-save\.pth are missing .*get them from the DISK repository of cvlab-epfl"
    with use_runtime(Runtime(weights=tmp_path)), pytest.raises(InputError, match=message):
        load_network(network(), "disk")


def test_weights_in_the_cache_of_the_hub_are_loaded(hub, monkeypatch, tmp_path):
    monkeypatch.delenv(FOLDER, raising=False)
    saved = network()
    torch.save(saved.state_dict(), tmp_path / "depth-save.pth")
    monkeypatch.setattr(hub, "try_to_load_from_cache", lambda *_: str(tmp_path / "depth-save.pth"))
    assert equal(values_of(load_network(network(), "disk")), values_of(saved))


def test_the_device_is_the_runtimes_or_the_users_default(monkeypatch):
    monkeypatch.setenv(DEVICE, "cpu")
    assert choose_device().type == "cpu"
    monkeypatch.setenv(DEVICE, "abacus")
    with pytest.raises(InputError, match="device must be auto, cpu or cuda, got 'abacus'"):
        choose_device()
    with use_runtime(Runtime(device="cpu")):
        assert choose_device().type == "cpu"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_an_error():
    with (
        use_runtime(Runtime(device="cuda")),
        pytest.raises(InputError, match="torch finds no GPU; set the device to cpu"),
    ):
        choose_device()
