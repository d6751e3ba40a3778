"""Networks of PyTorch as ONNX files: writing them, and running them on tensors."""

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from slimsfm.networks.onnx_files import (
    CHECKSUM,
    METHOD,
    ArrayRun,
    import_for_onnx,
    onnx_network,
    weights_checksum,
)

Run = Callable[..., tuple[Tensor, ...]]
"""Takes the inputs of a network in order, and returns its outputs in order."""

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
        method: Key of `slimsfm.weight_files.WEIGHTS`.
        path: Path of the file.

    Raises:
        InputError: A package for writing ONNX files is not installed.
    """
    for package in ("onnx", "onnxscript"):
        import_for_onnx(package)
    free = torch.export.Dim.DYNAMIC
    axes = tuple(dict.fromkeys(part.dynamic.get(name, ()), free) for name in part.inputs)
    with _quiet():
        program = torch.onnx.export(
            _Positional(part.network).eval(),
            tuple(part.inputs.values()),
            dynamo=True,
            optimize=False,  # onnxruntime does it, in less time
            dynamic_shapes=(axes,),
            input_names=list(part.inputs),
            output_names=list(part.outputs),
            verbose=False,
        )
    if program is None:
        raise RuntimeError("torch.onnx.export returned nothing")
    for node in program.model.graph:
        node.metadata_props.clear()  # the stack trace of each node
    program.model.metadata_props.update({METHOD: method, CHECKSUM: weights_checksum(method)})
    program.save(path)


def onnx_run(method: str) -> Run | None:
    """Load METHOD.onnx from the weights folder, for tensors; see `onnx_files.onnx_network`."""
    network = onnx_network(method)
    return _for_tensors(network) if network else None


@lru_cache(maxsize=8)
def _for_tensors(network: ArrayRun) -> Run:
    def run(*inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(one) for one in network(*(one.numpy() for one in inputs)))

    return run


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
