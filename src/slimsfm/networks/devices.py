"""The device on which networks run."""

import torch

from slimsfm.errors import InputError
from slimsfm.weights import current_runtime


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
