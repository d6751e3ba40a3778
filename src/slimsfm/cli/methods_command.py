"""`slimsfm methods`."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated

from rich.table import Table

from slimsfm.cli.networks import Networks
from slimsfm.cli.options import Advanced
from slimsfm.cli.output import console
from slimsfm.errors import InputError
from slimsfm.features.methods import plugins
from slimsfm.weights import WEIGHTS, find_weights


@dataclass(frozen=True, kw_only=True)
class _Method:
    kind: str
    name: str
    by: str
    licence: str
    weights: tuple[str, ...] = ()


_LEARNED = ("torch", "kornia", "transformers")  # what methods with weights need
_METHODS = (
    _Method(kind="extractor", name="sift", by="OpenCV", licence="Apache-2.0"),
    _Method(
        kind="extractor",
        name="aliked",
        by="kornia",
        licence="Apache-2.0",
        weights=("aliked-n16", "aliked-t16"),
    ),
    _Method(kind="extractor", name="disk", by="kornia", licence="Apache-2.0", weights=("disk",)),
    _Method(
        kind="extractor",
        name="superpoint",
        by="transformers",
        licence="Apache-2.0",
        weights=("superpoint",),
    ),
    _Method(kind="matcher", name="nearest", by="slimsfm", licence="BSD-3-Clause"),
    _Method(
        kind="matcher",
        name="lightglue",
        by="kornia",
        licence="Apache-2.0",
        weights=tuple(name for name in WEIGHTS if name.startswith("lightglue-")),
    ),
    _Method(
        kind="matcher",
        name="superglue",
        by="transformers",
        licence="Apache-2.0",
        weights=("superglue",),
    ),
    _Method(
        kind="detector-free",
        name="loftr",
        by="kornia",
        licence="Apache-2.0",
        weights=("loftr", "loftr-onepose++"),
    ),
    *(
        _Method(kind="strategy", name=name, by="slimsfm", licence="BSD-3-Clause")
        for name in ("exhaustive", "retrieval", "progressive", "direct")
    ),
    *(
        _Method(
            kind="strategy",
            name=name,
            by="slimsfm",
            licence="BSD-3-Clause",
            weights=(name,),
        )
        for name in ("onepose", "onepose++")
    ),
)


def methods(networks: Annotated[Networks, Advanced()] = Networks()) -> None:
    """List extractors, matchers and strategies: who wrote them, their licences, whether weights are here.

    Args:
        networks: Where weights are.
    """
    networks.apply()
    table = Table(box=None, header_style="bold", pad_edge=False)
    for column in ("", "method", "code", "licence", "weights", "their licence", "found"):
        table.add_column(column)
    for method in _METHODS:
        code = method.kind, method.name, method.by, method.licence
        if not method.weights:
            table.add_row(*code, "none needed", "", _installed(method))
        for row, name in enumerate(method.weights):
            weights = WEIGHTS[name]
            first = code if row == 0 else ("", "", "", "")
            table.add_row(*first, weights.file, weights.licence, _found(method, name))
    for kind in ("extractor", "matcher", "strategy"):
        for name, path in sorted(plugins(kind).items()):
            table.add_row(kind, name, path, "its own", "", "", "plug-in")
    console.print(table)
    console.print(
        "weights are sought in --weights or SLIMSFM_WEIGHTS, then in the libraries' caches, which fetch them "
        "where there is a network",
        style="dim",
    )


def _installed(method: _Method) -> str:
    missing = [name for name in (_LEARNED if method.weights else ()) if find_spec(name) is None]
    return f"needs {', '.join(missing)}: pip install 'slimsfm[learned]'" if missing else "yes"


def _found(method: _Method, name: str) -> str:
    if (installed := _installed(method)) != "yes":
        return installed
    try:
        return "yes" if find_weights(name) else "not in the folder"
    except InputError:
        return "no: another file of that name"
