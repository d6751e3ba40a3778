"""Where networks run."""

import os
from typing import Literal

import torch

from slimsfm.errors import InputError
from slimsfm.weights import DEVICE

DeviceName = Literal["auto", "cpu", "cuda"]


def choose_device(wish: DeviceName | None = None) -> torch.device:
    """The device to run on: as wished, else as SLIMSFM_DEVICE says; auto takes a GPU if there is one.

    Raises:
        InputError: A GPU is wished for and there is none, or there is no such device.
    """
    name = wish or os.environ.get(DEVICE, "auto")
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"device must be auto, cpu or cuda, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda: torch sees no GPU here; use --device cpu or auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def inference(device: torch.device) -> torch.autocast:
    """A context in which networks run: half precision on a GPU, single precision elsewhere."""
    return torch.autocast(device.type, dtype=torch.float16, enabled=device.type == "cuda")
