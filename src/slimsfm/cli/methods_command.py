"""`slimsfm methods`."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated

from rich.table import Table

from slimsfm.cli.arguments import Networks
from slimsfm.cli.options import Advanced
from slimsfm.cli.output import console
from slimsfm.errors import InputError
from slimsfm.features.registry import EXTRACTORS, plugins
from slimsfm.localization.calibration import CALIBRATED
from slimsfm.weight_files import WEIGHTS
from slimsfm.weights import cached_weights, current_runtime, find_weights


@dataclass(frozen=True, kw_only=True)
class _Method:
    kind: str
    name: str
    by: str
    license: str
    weights: tuple[str, ...] = ()
    needs_torch: bool = True  # also if there is an ONNX file


_LEARNED = ("torch", "kornia", "transformers")  # required by methods with weights
_METHODS = (
    _Method(kind="extractor", name="sift", by="OpenCV", license="Apache-2.0"),
    _Method(
        kind="extractor",
        name="aliked",
        by="kornia",
        license="Apache-2.0",
        weights=("aliked-n16", "aliked-t16"),
    ),
    _Method(kind="extractor", name="disk", by="kornia", license="Apache-2.0", weights=("disk",)),
    _Method(
        kind="extractor",
        name="superpoint",
        by="transformers",
        license="Apache-2.0",
        weights=("superpoint",),
    ),
    _Method(
        kind="extractor",
        name="xfeat",
        by="kornia",
        license="Apache-2.0",
        weights=("xfeat",),
        needs_torch=False,
    ),
    _Method(kind="matcher", name="nearest", by="slimsfm", license="BSD-3-Clause"),
    _Method(
        kind="matcher",
        name="lightglue",
        by="kornia",
        license="Apache-2.0",
        weights=tuple(name for name in WEIGHTS if name.startswith("lightglue-")),
    ),
    _Method(kind="matcher", name="lighterglue", by="kornia", license="Apache-2.0", weights=("lighterglue",)),
    _Method(
        kind="matcher",
        name="superglue",
        by="transformers",
        license="Apache-2.0",
        weights=("superglue",),
    ),
    _Method(
        kind="detector-free",
        name="loftr",
        by="kornia",
        license="Apache-2.0",
        weights=("loftr", "loftr-onepose++"),
    ),
    *(
        _Method(kind="strategy", name=name, by="slimsfm", license="BSD-3-Clause")
        for name in ("exhaustive", "retrieval", "progressive", "direct")
    ),
    *(
        _Method(
            kind="strategy",
            name=name,
            by="slimsfm",
            license="BSD-3-Clause",
            weights=(name,),
        )
        for name in ("onepose", "onepose++")
    ),
)


def methods(networks: Annotated[Networks, Advanced()] = Networks()) -> None:
    """List extractors, matchers and strategies with their origins, licenses and weights.

    Args:
        networks: Where the weights are.
    """
    networks.apply()
    table = Table(box=None, header_style="bold", pad_edge=False)
    for column in ("", "method", "code", "license", "weights", "their license", "found"):
        table.add_column(column)
    for method in _METHODS:
        code = method.kind, method.name, method.by, method.license
        if not method.weights:
            table.add_row(*code, "none needed", "", _installed(method))
        for row, name in enumerate(method.weights):
            weights = WEIGHTS[name]
            first = code if row == 0 else ("", "", "", "")
            table.add_row(*first, weights.file, weights.license, _found(method, name))
    for kind in ("extractor", "matcher", "strategy"):
        for name, path in sorted(plugins(kind).items()):
            table.add_row(kind, name, path, "its own", "", "", "plug-in")
    console.print(table)
    if uncalibrated := sorted({*EXTRACTORS, *plugins("extractor")} - CALIBRATED):
        console.print(
            f"confidence not calibrated for these extractors: {', '.join(uncalibrated)}", style="dim"
        )
    packages = " and ".join(sorted({one.package.name for one in WEIGHTS.values() if one.package}))
    console.print(
        f"weights are searched for in --weights or $SLIMSFM_WEIGHTS, then in the packages {packages}, "
        "then in the caches of the libraries, which download them if there is a network",
        style="dim",
    )


def _installed(method: _Method) -> str:
    missing = [name for name in (_LEARNED if method.weights else ()) if find_spec(name) is None]
    return f"needs {', '.join(missing)}: pip install 'slimsfm[learned]'" if missing else "yes"


def _found(method: _Method, name: str) -> str:
    """Where weights come from, and whether they run."""
    folder = current_runtime().weights
    exported = " and ONNX" if folder and (folder / f"{name}.onnx").is_file() else ""
    runs_without = exported and not method.needs_torch and find_spec("onnxruntime")
    if (installed := _installed(method)) != "yes" and not runs_without:
        return installed
    try:
        found = find_weights(name) or cached_weights(name)
    except InputError:
        return "no: not the published file"
    if found:
        return found.origin + exported
    package = WEIGHTS[name].package
    return exported.removeprefix(" and ") or ("no: " + package.install if package else "no")
