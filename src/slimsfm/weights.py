"""Weight files of learned methods: names, sources and licenses, and where a process looks for them.

A weight file is looked up in the weights folder, then in the cache of the library through which the authors
publish it; that library downloads it if there is a network. Nothing here imports the deep-learning stack.
"""

import hashlib
import logging
import os
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, get_args

from slimsfm.errors import InputError

FOLDER = "SLIMSFM_WEIGHTS"
"""Environment variable with the user's default weights folder."""

DEVICE = "SLIMSFM_DEVICE"
"""Environment variable with the user's default device: auto, cpu or cuda."""

_RESEARCH = "Magic Leap: research only"

DeviceName = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True, kw_only=True)
class Runtime:
    """Where learned methods find their weights, and where their networks run."""

    weights: Path | None = None
    """Folder of weight files; None: only the caches of the libraries are searched."""

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


@dataclass(frozen=True, kw_only=True)
class WeightFile:
    """A published file of trained weights."""

    file: str
    """File name, as published by the authors."""

    source: str
    """Who publishes the file."""

    license: str
    """License of the weights."""

    hub: tuple[str, ...] = ()
    """Addresses from which the library downloads it, or `hf:OWNER/REPOSITORY/FILE`; may be empty."""

    sha256: str | None = None
    """Checksum; None if unknown: then only names and shapes of the values are validated."""

    @property
    def is_research_only(self) -> bool:
        """Whether commercial use is forbidden."""
        return self.license == _RESEARCH


def _aliked(name: str, sha256: str) -> WeightFile:
    return WeightFile(
        file=f"{name}.pth",
        source="the ALIKED repository of Shiaoming",
        license="BSD-3-Clause",
        hub=(f"https://github.com/Shiaoming/ALIKED/raw/main/models/{name}.pth",),
        sha256=sha256,
    )


def _lightglue(features: str) -> WeightFile:
    return WeightFile(
        file=f"{features}_lightglue.pth",
        source="the LightGlue repository of cvg, release v0.1_arxiv",
        license="Apache-2.0",
        hub=(f"https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/{features}_lightglue.pth",),
    )


WEIGHTS = {
    "aliked-n16": _aliked("aliked-n16", "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2"),
    "aliked-t16": _aliked("aliked-t16", "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085"),
    "disk": WeightFile(
        file="depth-save.pth",
        source="the DISK repository of cvlab-epfl",
        license="Apache-2.0",
        hub=("hf:kornia/disk/depth-save.pth",),
    ),
    "superpoint": WeightFile(
        file="superpoint_v1.pth",
        source="the SuperGluePretrainedNetwork repository of magicleap",
        license=_RESEARCH,
        hub=("hf:magic-leap-community/superpoint/model.safetensors",),
    ),
    "superglue": WeightFile(
        file="superglue_outdoor.pth",
        source="the SuperGluePretrainedNetwork repository of magicleap",
        license=_RESEARCH,
        hub=("hf:magic-leap-community/superglue_outdoor/model.safetensors",),
    ),
    **{f"lightglue-{name}": _lightglue(name) for name in ("aliked", "disk", "sift", "superpoint")},
    "loftr": WeightFile(
        file="loftr_outdoor.ckpt",
        source="the LoFTR repository of zju3dv",
        license="Apache-2.0",
        hub=("hf:kornia/loftr/loftr_outdoor.ckpt",),
    ),
    "loftr-onepose++": WeightFile(
        file="LoFTR_wsize9.ckpt",
        source="the OnePose_Plus_Plus repository of zju3dv, whose README links it",
        license="Apache-2.0",
    ),
    "onepose": WeightFile(
        file="GATsSPG.ckpt",
        source="the OnePose repository of zju3dv, whose README links it",
        license="Apache-2.0",
    ),
    "onepose++": WeightFile(
        file="OnePosePlus_model.ckpt",
        source="the OnePose_Plus_Plus repository of zju3dv, whose README links it",
        license="Apache-2.0",
    ),
}
"""Every weight file of a built-in method."""


def find_weights(name: str) -> Path | None:
    """Find weights in the weights folder and validate their checksum; None if they are not there.

    Args:
        name: Key of `WEIGHTS`.

    Raises:
        InputError: The folder does not exist, or the file is not the published one.
    """
    weights, folder = WEIGHTS[name], current_runtime().weights
    path = folder / weights.file if folder else None
    if path is None or not path.is_file():
        return None
    check_weights(path, weights)
    return path


def check_weights(path: Path, weights: WeightFile) -> None:
    """Make sure that a file is the published one, if its checksum is known.

    Raises:
        InputError: The checksum differs, or the file cannot be read.
    """
    if weights.sha256 is None:
        return
    stat = path.stat()
    if _sha256(path, stat.st_size, stat.st_mtime_ns) != weights.sha256:
        raise InputError(
            f"{path}: not the published weights (the checksum differs); "
            f"get {weights.file} from {weights.source}"
        )


@cache
def _sha256(path: Path, _size: int, _changed: int) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def missing(weights: WeightFile) -> InputError:
    """The error for weights that are neither in the weights folder nor can be downloaded."""
    where = next((f" ({one})" for one in weights.hub if not one.startswith("hf:")), "")
    return InputError(
        f"the weights {weights.file} are missing and could not be downloaded; get them from "
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
