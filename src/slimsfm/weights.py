"""Where a process finds the weights of learned methods, and where their networks run.

A weight file is looked up in the weights folder, then in installed packages that carry it, then in the cache
of the library through which the authors publish it; that library downloads it if there is a network. Nothing
here imports the deep-learning stack or one of those packages.
"""

import hashlib
import logging
import os
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from slimsfm.errors import InputError
from slimsfm.weight_files import WEIGHTS, Package, WeightFile

FOLDER = "SLIMSFM_WEIGHTS"
"""Environment variable with the user's default weights folder."""

DEVICE = "SLIMSFM_DEVICE"
"""Environment variable with the user's default device: auto, cpu or cuda."""

DeviceName = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True, kw_only=True)
class Runtime:
    """Where learned methods find their weights, and where their networks run."""

    weights: Path | None = None
    """Folder of weight files; None: only packages and the caches of the libraries are searched."""

    device: DeviceName = "auto"
    """Device of the networks; auto: a GPU if there is one."""

    def __post_init__(self) -> None:
        _check_device(self.device)
        if self.weights is not None and not self.weights.is_dir():
            raise InputError(
                f"{self.weights}: no such folder of weights; set the weights folder to an existing one "
                f"(environment variable {FOLDER})"
            )

    @classmethod
    def from_environment(
        cls, weights: str | Path | None = None, device: DeviceName | None = None
    ) -> "Runtime":
        """The user's defaults, from the environment variables, for what is not given.

        Raises:
            InputError: The folder does not exist, or the device is unknown.
        """
        folder = weights or os.environ.get(FOLDER)
        name: str = device or os.environ.get(DEVICE) or "auto"
        _check_device(name)
        return cls(weights=Path(folder) if folder else None, device=name)  # pyright: ignore[reportArgumentType]


def _check_device(name: str) -> None:
    if name not in get_args(DeviceName):
        raise InputError(f"device must be auto, cpu or cuda, got {name!r}")


_used: Runtime | None = None


def use_runtime(runtime: Runtime | None) -> AbstractContextManager:
    """Use a runtime for all networks that this process loads or runs from now on, on any thread.

    Args:
        runtime: None: the user's defaults.

    Returns:
        A context manager that restores the previous runtime at its end; it may be ignored.
    """
    global _used
    restoring = ExitStack()
    restoring.callback(_restore, _used)
    _used = runtime
    return restoring


def _restore(runtime: Runtime | None) -> None:
    global _used
    _used = runtime


def chosen_runtime() -> Runtime | None:
    """The runtime of the last `use_runtime`; None: the user's defaults. Passed on to worker processes."""
    return _used


def current_runtime() -> Runtime:
    """The runtime in use.

    Raises:
        InputError: The user's default folder does not exist, or the default device is unknown.
    """
    return _used or Runtime.from_environment()


class FoundWeights(NamedTuple):
    """A weight file that was found."""

    path: Path
    """The file."""

    origin: str
    """Where it was found, to be read by people."""


def find_weights(name: str) -> FoundWeights | None:
    """Find weights in the weights folder or in an installed package, and validate their checksum.

    Args:
        name: Key of `WEIGHTS`.

    Returns:
        The file; None if it is in neither.

    Raises:
        InputError: The folder does not exist, or the file is not the published one.
    """
    weights, folder = WEIGHTS[name], current_runtime().weights
    path = folder / weights.file if folder else None
    if path is not None and path.is_file():
        check_weights(path, weights)
        return FoundWeights(path, "weights folder")
    return _from_package(weights.package) if weights.package else None


def _from_package(package: Package) -> FoundWeights | None:
    try:
        installed = distribution(package.name)
    except PackageNotFoundError:
        return None
    path = Path(str(installed.locate_file(package.file)))
    if not path.is_file():
        return None
    if checksum_of(path) != package.sha256:
        raise InputError(
            f"{path}: not the published weights (the checksum differs); install the package again: "
            f"{package.install} --force-reinstall"
        )
    return FoundWeights(path, f"package {package.name} {installed.version}")


def check_weights(path: Path, weights: WeightFile) -> None:
    """Make sure that a file is the published one, if its checksum is known.

    Raises:
        InputError: The checksum differs, or the file cannot be read.
    """
    if weights.sha256 is not None and checksum_of(path) != weights.sha256:
        raise InputError(
            f"{path}: not the published weights (the checksum differs); "
            f"get {weights.file} from {weights.source}"
        )


def checksum_of(path: Path) -> str:
    """SHA-256 of a file, computed once as long as the file does not change.

    Raises:
        InputError: The file cannot be read.
    """
    try:
        stat = path.stat()
        return _sha256(path, stat.st_size, stat.st_mtime_ns)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


@cache
def _sha256(path: Path, _size: int, _changed: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def cached_weights(name: str) -> FoundWeights | None:
    """Find weights in the caches of PyTorch and Hugging Face, without their libraries and without a network.

    Args:
        name: Key of `WEIGHTS`.
    """
    for address in WEIGHTS[name].hub:
        if address.startswith("hf:"):
            owner, repository, file = address.removeprefix("hf:").split("/")
            found = sorted(_hugging_face().glob(f"models--{owner}--{repository}/snapshots/*/{file}"))
            library = "Hugging Face"
        else:
            found = [_torch() / "hub" / "checkpoints" / address.rpartition("/")[2]]
            library = "PyTorch"
        if found and found[0].is_file():
            return FoundWeights(found[0], f"cache of {library}")
    return None


def _torch() -> Path:
    return Path(os.environ.get("TORCH_HOME") or _caches() / "torch").expanduser()


def _hugging_face() -> Path:
    home = Path(os.environ.get("HF_HOME") or _caches() / "huggingface")
    return Path(os.environ.get("HF_HUB_CACHE") or home / "hub").expanduser()


def _caches() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")


def missing(weights: WeightFile) -> InputError:
    """The error for weights that were not found and cannot be downloaded."""
    where = next((f" ({one})" for one in weights.hub if not one.startswith("hf:")), "")
    package = f"install them with {weights.package.install}, or " if weights.package else ""
    return InputError(
        f"the weights {weights.file} are missing and could not be downloaded; {package}get them from "
        f"{weights.source}{where}, license {weights.license}, put the file into a folder, and set the "
        f"weights folder to it (environment variable {FOLDER})"
    )


@cache
def remind_of_license(name: str) -> None:
    """Warn once if weights are for research only."""
    if WEIGHTS[name].is_research_only:
        logging.getLogger("slimsfm").warning(
            "%s: the license (Magic Leap) allows research only, no commercial use", WEIGHTS[name].file
        )
