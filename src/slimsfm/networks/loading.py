"""The device of a network, and loading its weights: every value with the right name and shape."""

import pickle
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from socket import getaddrinfo
from types import ModuleType
from typing import Any, TypeVar
from urllib.parse import urlsplit
from urllib.request import getproxies
from zipfile import ZIP_STORED, ZipFile, is_zipfile

import torch
from torch import Tensor, nn

from slimsfm.errors import InputError
from slimsfm.limits import check_bytes
from slimsfm.weight_files import WEIGHTS
from slimsfm.weights import check_weights, current_runtime, find_weights, missing, remind_of_license


def choose_device() -> torch.device:
    """The device of the runtime in use; auto means a GPU if there is one.

    Raises:
        InputError: The runtime asks for a GPU, but there is none.
    """
    name = current_runtime().device
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda: torch finds no GPU; set the device to cpu or auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def inference(device: torch.device) -> torch.autocast:
    """A context in which networks run: half precision on a GPU, single precision on a CPU."""
    return torch.autocast(device.type, dtype=torch.float16, enabled=device.type == "cuda")


Network = TypeVar("Network", bound=nn.Module)
State = dict[str, Tensor]

_PLAIN = {"collections", "torch", "torch._utils", "torch.nn.parameter", "torch.storage"}
_PLAIN_NAMES = {"OrderedDict", "Size", "_rebuild_tensor_v2", "_rebuild_parameter"}


def load_network(
    network: Network,
    name: str,
    state_of: Callable[[Mapping], State] = dict,
    derived: Collection[str] = (),
) -> Network:
    """Load published weights into a network, and move it to the device, ready for inference.

    Args:
        network: An untrained network.
        name: Key of `slimsfm.weight_files.WEIGHTS`.
        state_of: Converts the contents of the file to the state dict of the network.
        derived: Values that the network computes itself and that may be missing in the file.

    Raises:
        InputError: The weights are missing, damaged, or of another network.
    """
    found = find_weights(name)
    load_state(network, found.path if found else _from_hub(name), state_of, derived)
    remind_of_license(name)
    return network.to(choose_device()).eval().requires_grad_(False)


def load_state(
    network: nn.Module,
    path: Path,
    state_of: Callable[[Mapping], State] = dict,
    derived: Collection[str] = (),
) -> None:
    """Load a file into a network completely or not at all; for the arguments see `load_network`.

    Raises:
        InputError: The file is damaged or of another network.
    """
    try:
        own = {key: value for key, value in network.state_dict().items() if key in derived}
        state = {**own, **state_of(_read(path))}
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: these are not the weights of {_name(network)} ({error!r})") from error
    wanted = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    found = {key: tuple(value.shape) for key, value in state.items()}
    if wanted != found:
        raise InputError(
            f"{path}: these are not the weights of {_name(network)}: {_difference(wanted, found)}"
        )
    network.load_state_dict(state, strict=True)


def matcher_state(checkpoint: Mapping) -> State:
    """Extract the matcher from a training checkpoint of LoFTR, OnePose or OnePose++.

    Names begin with `matcher.` in the authors' files, which may also hold an extractor, and without in
    kornia's.
    """
    prefix = "matcher."
    state = checkpoint["state_dict"]
    own = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
    return own or dict(state)


def _difference(wanted: dict[str, tuple], found: dict[str, tuple]) -> str:
    key = min(key for key in wanted.keys() | found.keys() if wanted.get(key) != found.get(key))
    if key not in found:
        return f"{key} is missing"
    if key not in wanted:
        return f"{key} is not one of its values"
    return f"{key} has shape {found[key]} instead of {wanted[key]}"


def _name(network: nn.Module) -> str:
    return type(network).__name__


def _read(path: Path) -> Mapping:
    """Read a weight file without running code that it may contain; its parts must not be compressed."""
    try:
        check_bytes(path, path.stat().st_size)
        if is_zipfile(path):
            with ZipFile(path) as archive:
                if any(one.compress_type != ZIP_STORED for one in archive.infolist()):
                    raise ValueError("its parts are compressed")
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        return torch.load(path, map_location="cpu", weights_only=False, pickle_module=_HARMLESS)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # damaged files raise all kinds of exceptions
        raise InputError(f"{path}: not a weight file, or damaged ({error})") from error


class _Ignored(dict):
    """Replaces the other objects in checkpoints of training frameworks."""

    def __new__(cls, *_args: object, **_kwargs: object) -> "_Ignored":
        return super().__new__(cls)

    def __init__(self, *_args: object, **_kwargs: object) -> None:
        super().__init__()

    def __call__(self, *_args: object, **_kwargs: object) -> "_Ignored":
        return self

    def __setstate__(self, _state: object) -> None: ...

    def append(self, _item: object) -> None: ...

    def extend(self, _items: object) -> None: ...


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        is_storage = module == "torch" and name.endswith("Storage")
        if module in _PLAIN and (name in _PLAIN_NAMES or is_storage):
            return super().find_class(module, name)
        return _Ignored


_HARMLESS = ModuleType("slimsfm_harmless_pickle")
_HARMLESS.Unpickler = _Unpickler  # pyright: ignore[reportAttributeAccessIssue]
_HARMLESS.load = lambda file, **options: _Unpickler(file, **options).load()  # pyright: ignore[reportAttributeAccessIssue]


def _from_hub(name: str) -> Path:
    """The file in the cache of its library, which downloads it if there is a network."""
    weights = WEIGHTS[name]
    for address in weights.hub:
        path = _from_hugging_face(address) if address.startswith("hf:") else _from_address(address)
        if path is not None:
            if not address.startswith("hf:"):
                check_weights(path, weights)
            return path
    raise missing(weights)


def _from_hugging_face(address: str) -> Path | None:
    from huggingface_hub import constants, hf_hub_download, try_to_load_from_cache

    owner, repository, file = address.removeprefix("hf:").split("/")
    cached = try_to_load_from_cache(f"{owner}/{repository}", file)
    if isinstance(cached, str):
        return Path(cached)
    if not _is_known(constants.ENDPOINT):
        return None
    try:
        return Path(hf_hub_download(f"{owner}/{repository}", file))
    except Exception:  # no network, no such file, a proxy: in any case it is not available
        return None


def _is_known(address: str) -> bool:
    """Whether a host name resolves: without a network, libraries retry for half a minute with warnings."""
    if getproxies():
        return True
    try:
        return bool(getaddrinfo(urlsplit(address).hostname, 443))
    except OSError:
        return False


def _from_address(address: str) -> Path | None:
    path = Path(torch.hub.get_dir()) / "checkpoints" / address.rpartition("/")[2]
    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(address, str(path), progress=False)
        return path
    except Exception:  # as above
        return None
