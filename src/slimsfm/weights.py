"""The weight files of learned methods: what they are called, where they come from, what one may do with them.

A file is sought in the folder that the environment variable SLIMSFM_WEIGHTS names (`--weights` of the command
line sets it), else in the cache of the library that the method's authors or ported it publish through, which
fetches it where there is a network. Nothing here needs the deep-learning stack.
"""

import hashlib
import logging
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from slimsfm.errors import InputError

FOLDER = "SLIMSFM_WEIGHTS"
"""Environment variable that names the folder of weight files."""

_RESEARCH = "Magic Leap: research only"


DEVICE = "SLIMSFM_DEVICE"
"""Environment variable that says where networks run: auto, cpu or cuda."""


@dataclass(frozen=True, kw_only=True)
class WeightFile:
    """A published file of trained weights."""

    file: str
    """Its name, as the authors published it."""

    source: str
    """Who published it, by name."""

    licence: str
    """What one may do with the weights."""

    hub: tuple[str, ...] = ()
    """Where its library finds it: addresses, or `hf:OWNER/REPOSITORY/FILE`; may be nowhere."""

    sha256: str | None = None
    """Checksum, where it is known; else keys and shapes must do."""

    @property
    def is_research_only(self) -> bool:
        """Whether commercial use is forbidden."""
        return self.licence == _RESEARCH


def _aliked(name: str, sha256: str) -> WeightFile:
    return WeightFile(
        file=f"{name}.pth",
        source="the ALIKED repository of Shiaoming",
        licence="BSD-3-Clause",
        hub=(f"https://github.com/Shiaoming/ALIKED/raw/main/models/{name}.pth",),
        sha256=sha256,
    )


def _lightglue(features: str) -> WeightFile:
    return WeightFile(
        file=f"{features}_lightglue.pth",
        source="the LightGlue repository of cvg, release v0.1_arxiv",
        licence="Apache-2.0",
        hub=(f"https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/{features}_lightglue.pth",),
    )


WEIGHTS = {
    "aliked-n16": _aliked("aliked-n16", "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2"),
    "aliked-t16": _aliked("aliked-t16", "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085"),
    "disk": WeightFile(
        file="depth-save.pth",
        source="the DISK repository of cvlab-epfl",
        licence="Apache-2.0",
        hub=("hf:kornia/disk/depth-save.pth",),
    ),
    "superpoint": WeightFile(
        file="superpoint_v1.pth",
        source="the SuperGluePretrainedNetwork repository of magicleap",
        licence=_RESEARCH,
        hub=("hf:magic-leap-community/superpoint/model.safetensors",),
    ),
    "superglue": WeightFile(
        file="superglue_outdoor.pth",
        source="the SuperGluePretrainedNetwork repository of magicleap",
        licence=_RESEARCH,
        hub=("hf:magic-leap-community/superglue_outdoor/model.safetensors",),
    ),
    **{f"lightglue-{name}": _lightglue(name) for name in ("aliked", "disk", "sift", "superpoint")},
    "loftr": WeightFile(
        file="loftr_outdoor.ckpt",
        source="the LoFTR repository of zju3dv",
        licence="Apache-2.0",
        hub=("hf:kornia/loftr/loftr_outdoor.ckpt",),
    ),
    "loftr-onepose++": WeightFile(
        file="LoFTR_wsize9.ckpt",
        source="the OnePose_Plus_Plus repository of zju3dv, whose README links it",
        licence="Apache-2.0",
    ),
    "onepose": WeightFile(
        file="GATsSPG.ckpt",
        source="the OnePose repository of zju3dv, whose README links it",
        licence="Apache-2.0",
    ),
    "onepose++": WeightFile(
        file="OnePosePlus_model.ckpt",
        source="the OnePose_Plus_Plus repository of zju3dv, whose README links it",
        licence="Apache-2.0",
    ),
}
"""Every weight file that a method may ask for."""


def weights_folder() -> Path | None:
    """The user's folder of weight files, if one is named.

    Raises:
        InputError: It is no folder.
    """
    named = os.environ.get(FOLDER)
    if not named:
        return None
    if not Path(named).is_dir():
        raise InputError(f"{named}: no such folder of weights; mend --weights or {FOLDER}")
    return Path(named)


def find_weights(name: str) -> Path | None:
    """The file of these weights in the user's folder, if it is there; its checksum is verified.

    Args:
        name: Key of `WEIGHTS`.

    Raises:
        InputError: The folder is none, or the file is another than was published.
    """
    weights, folder = WEIGHTS[name], weights_folder()
    path = folder / weights.file if folder else None
    if path is None or not path.is_file():
        return None
    check_weights(path, weights)
    return path


def check_weights(path: Path, weights: WeightFile) -> None:
    """Make sure that a file is the published one, as far as its checksum is known.

    Raises:
        InputError: It is not, or cannot be read.
    """
    if weights.sha256 is None:
        return
    stat = path.stat()
    if _sha256(path, stat.st_size, stat.st_mtime_ns) != weights.sha256:
        raise InputError(
            f"{path}: not the weights that were published (its checksum differs); "
            f"take {weights.file} from {weights.source}"
        )


@cache
def _sha256(path: Path, _size: int, _changed: int) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def missing(weights: WeightFile) -> InputError:
    """What to say where weights can be had neither from the folder nor from the hub."""
    return InputError(
        f"weights {weights.file} are missing; get them from {weights.source}, put them into a folder "
        f"and name it by --weights or {FOLDER}"
    )


@cache
def remind_of_licence(name: str) -> None:
    """Say once that weights are for research only, where they are."""
    if WEIGHTS[name].is_research_only:
        logging.getLogger("slimsfm").warning(
            "%s: its licence (Magic Leap) allows research only, no commercial use", WEIGHTS[name].file
        )
