"""`slimsfm export`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from slimsfm.cli.networks import Networks
from slimsfm.cli.output import (
    Flat,
    MapPath,
    OutputPath,
    Stopwatch,
    check_output,
    console,
    finish,
    parse,
    size,
)
from slimsfm.errors import InputError, OutputError
from slimsfm.features.registry import EXPORTABLE, export_method
from slimsfm.files import check_writable
from slimsfm.mapping.hloc import read_query_names, write_hloc
from slimsfm.mapping.io import read_map

_MethodName = Annotated[
    tyro.conf.Positional[str], tyro.conf.arg(metavar="METHOD", help=f"One of {', '.join(EXPORTABLE)}.")
]


def export_onnx(
    method: _MethodName,
    /,
    output: OutputPath,
    networks: Annotated[Networks, Flat] = Networks(),
    overwrite: bool = False,
) -> None:
    """Export the network of a method as an ONNX file, by which it runs on the CPU.

    It does so wherever the file lies in the folder of weights, named METHOD.onnx.

    Args:
        method: Which.
        output: Where the file is written.
        networks: Where weights are.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    networks.apply()
    if output.is_dir():
        raise OutputError(f"{output}: is a folder; name a file, such as {output / method}.onnx")
    check_writable(output, overwrite=overwrite)
    export_method(method, output, overwrite=overwrite)
    finish(f"{output}: {method}, {size(output.stat().st_size)}", watch)
    console.print(f"runs {method} on the CPU as {method}.onnx in the folder of weights", style="dim")


def export_hloc(
    map: MapPath, /, output: OutputPath, queries: Path | None = None, overwrite: bool = False
) -> None:
    """Export a map whose images have features as hloc's `match_features` and `localize_sfm` read it.

    The folder gets sfm/, features.h5, references.txt, matches.h5 where the map has matches, and
    pairs-queries.txt where queries are given: each query with every image of the map.

    Args:
        map: A map.
        output: Where the folder is written.
        queries: A folder of images, or a text file with a name a line, such as hloc's list of queries.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    for source in (map, queries) if queries else (map,):
        check_output(output, source, overwrite=overwrite)
    names = read_query_names(queries) if queries else []
    exported = read_map(map)
    write_hloc(exported, output, names, overwrite=overwrite)
    pairs = f", {len(names) * len(exported.images)} pairs of {len(names)} queries" if queries else ""
    finish(f"{output}: {len(exported.images)} images, {len(exported.point3D_ids)} points{pairs}", watch)
    console.print(
        f"hloc: match_features takes the pairs and features_ref={output / 'features.h5'}, "
        f"then localize_sfm takes {output / 'sfm'}",
        style="dim",
    )


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    kind, *rest = arguments or ["--help"]
    if kind in ("-h", "--help"):
        console.print("usage: slimsfm export onnx METHOD -o FILE   (more: slimsfm export onnx --help)")
        console.print("       slimsfm export hloc MAP -o OUT       (more: slimsfm export hloc --help)")
        return
    if kind not in _KINDS:
        raise InputError(f"{kind!r} is no kind of export; there is {', '.join(_KINDS)}")
    parse(_KINDS[kind], rest, kind)


_KINDS = {"onnx": export_onnx, "hloc": export_hloc}
