"""Networks in ONNX files, run by onnxruntime on the CPU; nothing here needs PyTorch.

If the weights folder holds METHOD.onnx, the method runs it on the CPU. The file records its method and the
checksum of its weights, and is refused if they do not match.
"""

import os
import sys
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from slimsfm.errors import InputError
from slimsfm.weight_files import WEIGHTS
from slimsfm.weights import checksum_of, current_runtime, find_weights, remind_of_license

ArrayRun = Callable[..., tuple[np.ndarray, ...]]
"""Takes the inputs of a network in order, and returns its outputs in order."""

METHOD, CHECKSUM = "slimsfm.method", "slimsfm.weights"  # keys of the metadata in a file


def onnx_network(method: str) -> ArrayRun | None:
    """Load METHOD.onnx from the weights folder; None if there is no such file, or networks run on a GPU.

    Args:
        method: Key of `slimsfm.weight_files.WEIGHTS`.

    Raises:
        InputError: The file is damaged or belongs to another method or to other weights than those that are
            found, or onnxruntime is not installed.
    """
    folder = current_runtime().weights
    path = folder / f"{method}.onnx" if folder else None
    if path is None or not path.is_file() or not _runs_on_cpu():
        return None
    stat = path.stat()
    return _load(path, method, _threads(), stat.st_size, stat.st_mtime_ns)


def _runs_on_cpu() -> bool:
    """Whether networks run on the CPU; PyTorch is asked only where it decides."""
    device = current_runtime().device
    if device == "cpu" or (device == "auto" and find_spec("torch") is None):
        return True
    from slimsfm.networks.loading import choose_device

    return choose_device().type == "cpu"


def _threads() -> int:
    """As many as PyTorch uses; 0: one per core."""
    if torch := sys.modules.get("torch"):
        return torch.get_num_threads()
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    return int(wanted) if wanted.isdecimal() else 0


@lru_cache(maxsize=8)
def _load(path: Path, method: str, threads: int, _size: int, _changed: int) -> ArrayRun:
    onnxruntime = import_for_onnx("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3  # errors
    # Spinning threads would take the cores from PyTorch or NumPy, which run the rest of the method.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # damaged files raise all kinds of exceptions
        reason = str(error).partition("\n")[0]
        raise InputError(f"{path}: onnxruntime cannot read it ({reason}); {_remedy(method)}") from error
    _check_origin(path, method, session.get_modelmeta().custom_metadata_map)
    remind_of_license(method)
    names = [one.name for one in session.get_inputs()]

    def run(*inputs: np.ndarray) -> tuple[np.ndarray, ...]:
        arrays = (np.ascontiguousarray(one) for one in inputs)
        return tuple(session.run(None, dict(zip(names, arrays, strict=True))))

    return run


def _check_origin(path: Path, method: str, origin: dict[str, str]) -> None:
    if origin.get(METHOD) != method:
        raise InputError(f"{path}: was not written by slimsfm export onnx {method}; {_remedy(method)}")
    here = weights_checksum(method)
    if here and origin.get(CHECKSUM) and here != origin[CHECKSUM]:
        raise InputError(
            f"{path}: was exported from other weights than {WEIGHTS[method].file}; {_remedy(method)}"
        )


def _remedy(method: str) -> str:
    return f"remove it, or export it again with slimsfm export onnx {method}"


def weights_checksum(method: str) -> str:
    """Checksum of the weights in the weights folder or in a package; empty if they are in neither."""
    found = find_weights(method)
    return checksum_of(found.path) if found else ""


def import_for_onnx(package: str) -> Any:
    """Import a package that ONNX files need.

    Raises:
        InputError: It is not installed.
    """
    try:
        return import_module(package)
    except ModuleNotFoundError as error:
        raise InputError(
            f"ONNX files need {error.name}, which is not installed: pip install 'slimsfm[onnx]'"
        ) from error
