"""Networks as ONNX files: written by PyTorch's exporter, run by onnxruntime on the CPU.

A file METHOD.onnx in the folder of weights is what this method runs by on the CPU. It knows what it was made
of, so that one of another method or of other weights is told, not run.
"""

import hashlib
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from slimsfm.errors import InputError
from slimsfm.networks.devices import choose_device
from slimsfm.weights import WEIGHTS, find_weights, remind_of_licence, weights_folder

Run = Callable[..., tuple[Tensor, ...]]
"""Takes a network's inputs in their order and gives its outputs in theirs."""

_METHOD, _WEIGHTS = "slimsfm.method", "slimsfm.weights"  # keys of what a file knows of itself
_NOISY = "torch.onnx", "torch.export", "onnxscript", "onnx_ir"  # loggers


@dataclass(frozen=True, kw_only=True, eq=False)
class Exportable:
    """What of a network an ONNX file holds: a static graph from tensors to tensors."""

    network: nn.Module
    """Takes the inputs, one after the other; ready for inference, on the CPU."""

    inputs: dict[str, Tensor]
    """Example of each, by name: axes that may have any length must be longer than 1 and differ in length."""

    dynamic: dict[str, tuple[int, ...]]
    """For each input the axes that may have any length."""

    outputs: tuple[str, ...]
    """Names of what the network gives."""


class _Positional(nn.Module):
    """Takes any number of inputs as such, so that the exporter needs to know no names."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> Any:
        return self.network(*inputs)


def write_onnx(part: Exportable, method: str, path: Path) -> None:
    """Write an ONNX file.

    Args:
        part: What it is to hold.
        method: Key of `slimsfm.weights.WEIGHTS`: whose network it is.
        path: Where it goes.

    Raises:
        InputError: What writes ONNX is not installed.
    """
    for package in ("onnx", "onnxscript"):
        _import(package)
    free = torch.export.Dim.DYNAMIC
    axes = tuple(dict.fromkeys(part.dynamic.get(name, ()), free) for name in part.inputs)
    with _quiet():
        program = torch.onnx.export(
            _Positional(part.network).eval(),
            tuple(part.inputs.values()),
            dynamo=True,
            dynamic_shapes=(axes,),
            input_names=list(part.inputs),
            output_names=list(part.outputs),
            verbose=False,
        )
    if program is None:
        raise RuntimeError("torch.onnx.export gave nothing")
    for node in program.model.graph:
        node.metadata_props.clear()  # where in whose source each comes from
    program.model.metadata_props.update({_METHOD: method, _WEIGHTS: _checksum(method)})
    program.save(path)


def onnx_run(method: str) -> Run | None:
    """What runs a method by onnxruntime; None where PyTorch is to: on a GPU, or without a METHOD.onnx.

    Args:
        method: Key of `slimsfm.weights.WEIGHTS`.

    Raises:
        InputError: The file is damaged, of another method or of other weights than the folder holds, or
            onnxruntime is not installed.
    """
    folder = weights_folder()
    path = folder / f"{method}.onnx" if folder else None
    if path is None or not path.is_file() or choose_device().type != "cpu":
        return None
    stat = path.stat()
    return _load(path, method, torch.get_num_threads(), stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=8)
def _load(path: Path, method: str, threads: int, _size: int, _changed: int) -> Run:
    onnxruntime = _import("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3  # errors
    # Threads that wait for work by spinning take the cores from PyTorch, which does the rest.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # what a damaged file raises is anybody's guess
        reason = str(error).partition("\n")[0]
        raise InputError(f"{path}: onnxruntime cannot read it ({reason}); {_anew(method)}") from error
    _check_origin(path, method, session.get_modelmeta().custom_metadata_map)
    remind_of_licence(method)
    names = [one.name for one in session.get_inputs()]

    def run(*inputs: Tensor) -> tuple[Tensor, ...]:
        arrays = (np.ascontiguousarray(one.numpy()) for one in inputs)
        found = session.run(None, dict(zip(names, arrays, strict=True)))
        return tuple(torch.from_numpy(one) for one in found)

    return run


def _check_origin(path: Path, method: str, origin: dict[str, str]) -> None:
    if origin.get(_METHOD) != method:
        raise InputError(f"{path}: was not made by slimsfm export onnx {method}; {_anew(method)}")
    here = _checksum(method)
    if here and origin.get(_WEIGHTS) and here != origin[_WEIGHTS]:
        raise InputError(f"{path}: was made of other weights than {WEIGHTS[method].file}; {_anew(method)}")


def _anew(method: str) -> str:
    return f"remove it, or make it anew by slimsfm export onnx {method}"


def _checksum(method: str) -> str:
    """Of the file of weights in the user's folder; nothing where there is none."""
    path = find_weights(method)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path else ""


def _import(package: str) -> Any:
    try:
        return import_module(package)
    except ModuleNotFoundError as error:
        raise InputError(
            f"ONNX files need {error.name}, which is not installed: pip install 'slimsfm[onnx]'"
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what the exporter says of its own insides from the user."""
    loggers = [logging.getLogger(name) for name in _NOISY]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
