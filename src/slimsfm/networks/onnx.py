"""Networks as ONNX files: written by PyTorch's exporter, run by onnxruntime on the CPU.

If the weights folder holds METHOD.onnx, the method runs it on the CPU. The file records its method and the
checksum of its weights, and is refused if they do not match.
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
from slimsfm.networks.loading import choose_device
from slimsfm.weights import WEIGHTS, current_runtime, find_weights, remind_of_license

Run = Callable[..., tuple[Tensor, ...]]
"""Takes the inputs of a network in order, and returns its outputs in order."""

_METHOD, _WEIGHTS = "slimsfm.method", "slimsfm.weights"  # keys of the metadata in a file
_NOISY = "torch.onnx", "torch.export", "onnxscript", "onnx_ir"  # loggers


@dataclass(frozen=True, kw_only=True, eq=False)
class Exportable:
    """The exportable part of a network: a static graph from tensors to tensors."""

    network: nn.Module
    """Takes the inputs in order; on the CPU, in evaluation mode."""

    inputs: dict[str, Tensor]
    """Example inputs by name; the dynamic axes must be longer than 1 and differ in length."""

    dynamic: dict[str, tuple[int, ...]]
    """Axes of any length, by input."""

    outputs: tuple[str, ...]
    """Names of the outputs."""


class _Positional(nn.Module):
    """Takes any number of positional inputs, so that the exporter does not need their names."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> Any:
        return self.network(*inputs)


def write_onnx(part: Exportable, method: str, path: Path) -> None:
    """Write an ONNX file.

    Args:
        part: The network to export.
        method: Key of `slimsfm.weights.WEIGHTS`.
        path: Path of the file.

    Raises:
        InputError: A package for writing ONNX files is not installed.
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
        raise RuntimeError("torch.onnx.export returned nothing")
    for node in program.model.graph:
        node.metadata_props.clear()  # the stack trace of each node
    program.model.metadata_props.update({_METHOD: method, _WEIGHTS: _checksum(method)})
    program.save(path)


def onnx_run(method: str) -> Run | None:
    """Load METHOD.onnx from the weights folder; None if there is no such file, or networks run on a GPU.

    Args:
        method: Key of `slimsfm.weights.WEIGHTS`.

    Raises:
        InputError: The file is damaged or belongs to another method or to other weights than those in the
            folder, or onnxruntime is not installed.
    """
    folder = current_runtime().weights
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
    # Spinning threads would take the cores from PyTorch, which runs the rest of the method.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # damaged files raise all kinds of exceptions
        reason = str(error).partition("\n")[0]
        raise InputError(f"{path}: onnxruntime cannot read it ({reason}); {_remedy(method)}") from error
    _check_origin(path, method, session.get_modelmeta().custom_metadata_map)
    remind_of_license(method)
    names = [one.name for one in session.get_inputs()]

    def run(*inputs: Tensor) -> tuple[Tensor, ...]:
        arrays = (np.ascontiguousarray(one.numpy()) for one in inputs)
        found = session.run(None, dict(zip(names, arrays, strict=True)))
        return tuple(torch.from_numpy(one) for one in found)

    return run


def _check_origin(path: Path, method: str, origin: dict[str, str]) -> None:
    if origin.get(_METHOD) != method:
        raise InputError(f"{path}: was not written by slimsfm export onnx {method}; {_remedy(method)}")
    here = _checksum(method)
    if here and origin.get(_WEIGHTS) and here != origin[_WEIGHTS]:
        raise InputError(
            f"{path}: was exported from other weights than {WEIGHTS[method].file}; {_remedy(method)}"
        )


def _remedy(method: str) -> str:
    return f"remove it, or export it again with slimsfm export onnx {method}"


def _checksum(method: str) -> str:
    """Checksum of the weight file in the weights folder; empty if it is not there."""
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
    """Suppress warnings and logs of the exporter."""
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
